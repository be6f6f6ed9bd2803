"""A hook of MkDocs: a formula between `$$` becomes MathML, which browsers set by themselves, and the version of
the package stands beside the site's name. No script and no font is loaded."""

import pathlib
import re
from typing import Any

ROOT = pathlib.Path(__file__).parent.parent.parent
FORMULA = re.compile(r"^\$\$\s(?P<latex>[^$]+?)\s\$\$$", re.MULTILINE)
CODE = re.compile(r"<(pre|code)\b.*?</\1>", re.DOTALL)
VERSION = re.compile(r'^__version__ = "(.+)"$', re.MULTILINE)


def mathml(latex: str) -> str:
    """Return a displayed formula as MathML."""
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]  # of the group `docs`

    return convert(latex, display="block")


def on_page_markdown(markdown: str, **given: Any) -> str:
    """Return the page with its formulas set."""
    del given
    return FORMULA.sub(lambda found: mathml(found["latex"]), markdown)


def on_page_content(html: str, page: Any, **given: Any) -> str:
    """Return the page as it is. Raises ValueError if it shows a formula as LaTeX."""
    del given
    if "$$" in CODE.sub("", html):
        raise ValueError(f"{page.file.src_uri}: $$ is left; a formula is a paragraph of its own, in $$ and spaces")
    return html


def on_config(config: Any) -> Any:
    """Return the configuration with the package's version."""
    found = VERSION.search((ROOT / "diffabs" / "__init__.py").read_text(encoding="utf-8"))
    assert found
    config["site_name"] = f"diffabs {found[1]}"
    return config
