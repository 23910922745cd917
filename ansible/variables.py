"""Writes the table of variables into ansible/README.md, from the role's argument_specs: python ansible/variables.py"""

from pathlib import Path

import yaml

HERE = Path(__file__).parent
SPECS = HERE / "roles" / "rover" / "meta" / "argument_specs.yml"
README = HERE / "README.md"
BEGIN, END = "<!-- variables -->\n", "<!-- end of variables -->\n"


def table() -> str:
    """Return the table: a row for each variable, in the order of the specs."""
    entries = yaml.safe_load(SPECS.read_text())["argument_specs"].values()
    lines = ["variable | default | means", "---|---|---"]
    for name, o in {name: o for spec in entries for name, o in spec["options"].items()}.items():
        default = "must be given" if o.get("required") else f"`{_shown(o['default'])}`"
        others = [choice for choice in o.get("choices", ()) if choice != o["default"]]
        lines.append(f"`{name}` | {default}{' or ' * bool(others)}{', '.join(others)} | {o['description']}")
    return "\n".join(lines) + "\n"


def _shown(value: object) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text.replace("{{ playbook_dir }}/../", "").replace("|", "\\|")


def filled(readme: str) -> str:
    """Return the README with the present table in it."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


if __name__ == "__main__":
    README.write_text(filled(README.read_text()))
