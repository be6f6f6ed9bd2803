"""A hook of MkDocs: a formula between `$$` lines becomes MathML, which browsers set by themselves, and the version of
the package stands beside the site's name. No script and no font is loaded."""

import pathlib
import re
from typing import Any

ROOT = pathlib.Path(__file__).parent.parent
FORMULA = re.compile(r"^\$\$\n(?P<latex>.+?)\n\$\$$", re.MULTILINE | re.DOTALL)
VERSION = re.compile(r'^__version__ = "(.+)"$', re.MULTILINE)


def mathml(latex: str) -> str:
    """Return a displayed formula as MathML."""
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]  # of the group `docs`

    return convert(latex, display="block")


def on_page_markdown(markdown: str, **given: Any) -> str:
    """Return the page with its formulas set."""
    del given
    return FORMULA.sub(lambda found: mathml(found["latex"]), markdown)


def on_config(config: Any) -> Any:
    """Return the configuration with the package's version."""
    found = VERSION.search((ROOT / "diffabs" / "__init__.py").read_text(encoding="utf-8"))
    assert found
    config["site_name"] = f"diffabs {found[1]}"
    return config
