"""The Japanese README says what the English one says: its headings, code, links, and every number of each section."""

import re
from collections import Counter

import pytest
from project import ROOT

FENCED = re.compile(r"^```.*?^```|^    [^\n]*$", re.MULTILINE | re.DOTALL)


def pages():
    return tuple((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "README.ja.md"))


def headings(text):
    """Levels, in order."""
    return [len(mark) for mark in re.findall(r"^(#+) ", FENCED.sub("", text), re.MULTILINE)]


def code(text):
    """Blocks, and what stands in backticks."""
    inline = Counter(re.sub(r"\s+", " ", one) for one in re.findall(r"`([^`]+)`", FENCED.sub("", text)))
    return FENCED.findall(text), inline


def links(text):
    """Where links and figures lead, but from one of the two pages to the other."""
    return [to for to in re.findall(r"\]\(([^)]+)\)", FENCED.sub("", text)) if not to.startswith("README")]


def numbers(text):
    """How often each number stands in each section, outside of code and links; of a table, in each of its rows."""
    told = re.sub(r"`[^`]+`|\]\([^)]+\)", " ", FENCED.sub("", text))
    parts = [piece for section in re.split(r"^#+ ", told, flags=re.MULTILINE) for piece in _parts(section)]
    return [Counter(re.findall(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e-?\d+)?", part)) for part in parts]


def _parts(section):
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return ["\n".join(line for line in section.splitlines() if not line.startswith("|")), *rows]


@pytest.mark.parametrize("what", [headings, code, links, numbers], ids=lambda what: what.__name__)
def test_it_has_the_same(what):
    english, japanese = map(what, pages())
    assert japanese == english
    assert english


def test_what_would_not_be_the_same():
    """Another number, link, block or level is seen."""
    _, japanese = pages()
    for what, was, new in (
        (numbers, "93 % 超える", "94 % 超える"),
        (links, "docs/margins.md", "docs/margin.md"),
        (code, "0.3, 0.6, 4096", "0.3, 0.6, 409"),
        (headings, "## 限界", "### 限界"),
    ):
        changed = japanese.replace(was, new)
        assert changed != japanese
        assert what(changed) != what(japanese)


def test_it_is_in_japanese():
    told = FENCED.sub("", pages()[1])
    kana = re.findall(r"[\u3040-\u30ff\u4e00-\u9fff]", told)
    assert len(kana) > 0.4 * len(re.sub(r"\s|\]\([^)]+\)|`[^`]+`", "", told))
