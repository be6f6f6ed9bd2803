"""Pages whose code runs: the blocks of Python of a page one after the other, and the ```text block that may follow.

python tests/support/pages.py docs/journeys/lanes.md        writes into the page what its code prints
"""

import contextlib
import io
import pathlib
import re
import sys
import tempfile
from typing import NamedTuple

BLOCK = re.compile(r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<said>.*?)```\n)?", re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """Code, and what the page says that it prints; None where it says nothing."""

    code: str
    said: str | None
    line: int


def blocks(text: str) -> list[Block]:
    """Return the blocks of Python of a page, in order."""
    return [Block(one["code"], one["said"], text.count("\n", 0, one.start("code"))) for one in BLOCK.finditer(text)]


def printed(text: str, name: str) -> list[str]:
    """Return what each block of a page prints, run in one namespace, in the folder that is the current one."""
    names, found = {"__name__": "__main__"}, []
    for block in blocks(text):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile("\n" * block.line + block.code, name, "exec"), names)
        found.append("".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines()))
    return found


def written(text: str, outputs: list[str]) -> str:
    """Return the page with what its blocks print in its ```text blocks."""
    said = iter(outputs)

    def filled(one: re.Match[str]) -> str:
        out = next(said)
        return one[0] if one["said"] is None else one[0][: one.start("said") - one.start()] + out + "```\n"

    return BLOCK.sub(filled, text)


def main() -> None:
    """Run the pages that are named, and write what they print."""
    import matplotlib

    matplotlib.use("Agg")
    for name in sys.argv[1:]:
        page = pathlib.Path(name).resolve()
        text = page.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            outputs = printed(text, name)
        page.write_text(written(text, outputs), encoding="utf-8")
        print(f"{name}: {sum(map(len, outputs))} characters")


if __name__ == "__main__":
    main()
