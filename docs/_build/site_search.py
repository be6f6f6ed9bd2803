"""A hook of MkDocs: the site's search answers every query, with the pages that teach first.

lunr, which the search runs in the browser, merges nodes of its index whose keys are equal. A key joins labels and node
numbers, so a digit in a word can belong to either, and two unlike nodes are merged. A query that meets such a node ends
in a TypeError, and the page shows no results. A comma after each number makes the keys unique."""

import pathlib
import re
from typing import Any

# A newcomer looks for a part or an answer before a note on how the package is built. Other pages have weight 1.
WEIGHTS = {"reference/": 2.0, "faq": 2.0, "design-notes/": 0.1}
WEIGHTS |= dict.fromkeys(("experiments/", "papers", "validation", "test-status", "architecture", "compiler"), 0.3)
KEY = re.compile(r"\b(\w+)=\1\+(\w+)\+(\w+)\.id(?=\})")


def repaired(script: str) -> str:
    """Return lunr with unique keys. Raises ValueError if it is not the lunr that has the fault."""
    script, count = KEY.subn(r'\1=\1+\2+\3.id+","', script)
    if count != 1:
        raise ValueError(f"the search script has {count} places that join labels and numbers, 1 is expected")
    return script


def on_page_markdown(markdown: str, page: Any, **given: Any) -> str:
    """Return the page as it is, with its weight in the search."""
    del given
    for start, weight in WEIGHTS.items():
        if page.file.src_uri.startswith(start):
            page.meta["search"] = {"boost": weight}
    return markdown


def on_post_build(config: Any) -> None:
    """Repair the script of the built site."""
    (path,) = (pathlib.Path(config["site_dir"]) / "assets/javascripts/workers").glob("search.*.js")
    path.write_text(repaired(path.read_text(encoding="utf-8")), encoding="utf-8")
