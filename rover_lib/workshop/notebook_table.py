"""A table that a notebook shows as HTML, so that its cells can be copied, and a terminal as aligned text."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from rover_lib.onboard.columns import align


@dataclass(frozen=True)
class Table:
    """Rows of text below a header, all of one length; numbers of the second column on stand to the right.

    caption: a line above. notes: lines below.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    notes: Sequence[str] = ()

    def __str__(self) -> str:
        caption = [self.caption] if self.caption else []
        return "\n".join([*caption, *align([self.header, *self.rows]), *self.notes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        body = "\n".join(_line(row, "td") for row in self.rows)
        caption = f"<p><b>{escape(self.caption)}</b></p>\n" if self.caption else ""
        notes = "".join(f"\n<p>{escape(note)}</p>" for note in self.notes)
        head = f"<thead>{_line(self.header, 'th')}</thead>"
        return f"{caption}<table>\n{head}\n<tbody>\n{body}\n</tbody>\n</table>{notes}"


def _line(cells: Sequence[str], tag: str) -> str:
    styles = ["text-align: left", *["text-align: right"] * (len(cells) - 1)]
    cells_html = (f'<{tag} style="{style}">{escape(cell)}</{tag}>' for cell, style in zip(cells, styles, strict=True))
    return f"<tr>{''.join(cells_html)}</tr>"
