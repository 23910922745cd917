"""Writes the table of variables into ansible/README.md, from the role's argument_specs: python ansible/variables.py"""

from pathlib import Path

import yaml

HERE = Path(__file__).parent
SPECS = HERE / "roles" / "rover" / "meta" / "argument_specs.yml"
README = HERE / "README.md"
BEGIN, END = "<!-- variables -->\n", "<!-- end of variables -->\n"


def table() -> str:
    """Return the table: a row for each variable, in the order of the specs."""
    rows: dict[str, dict] = {}
    used: dict[str, list[str]] = {}
    for entry, spec in yaml.safe_load(SPECS.read_text())["argument_specs"].items():
        for name, option in spec["options"].items():
            rows[name] = option
            used.setdefault(name, []).append(entry)
    entries = len(yaml.safe_load(SPECS.read_text())["argument_specs"])
    lines = ["| variable | type | default | means | used by |", "|---|---|---|---|---|"]
    for name, o in rows.items():
        kind = o["type"] + (f" of {o['elements']}" if "elements" in o else "")
        kind = ", ".join(map(str, o["choices"])) if "choices" in o else kind
        default = "must be given" if o.get("required") else f"`{_shown(o['default'])}`"
        where = "all" if len(used[name]) > entries // 2 else ", ".join(used[name])
        lines.append(f"| `{name}` | {kind} | {default} | {o['description']} | {where} |")
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
