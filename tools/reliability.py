"""Write the rows that the tests have measured into the table of docs/reliability.md: reliability.py FOLDER."""

import json
import re
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
TABLE = re.compile(r"(?<=\n)(\| fault \|.*\n\| --- .*\n)(?:\|.*\n)*")


def main(folder: str) -> None:
    """Put the rows in FOLDER, in the order of their numbers, in the place of those that are there."""
    rows = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("*.json"))]
    if not rows:
        sys.exit(f"reliability: no rows in {folder}")
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |\n" for row in rows]
    page = TABLE.sub(lambda found: found[1] + "".join(lines), PAGE.read_text())
    PAGE.write_text(page)


if __name__ == "__main__":
    main(sys.argv[1])
