"""The site's reference: every package that exports names has a place there, and every name of it comes."""

import importlib
import importlib.util
import pathlib
import re
import shutil
import subprocess

import pytest

ROOT = pathlib.Path(__file__).parent.parent
DOCS = ROOT / "docs"
spec = importlib.util.spec_from_file_location("exported", DOCS / "exported.py")
exported = importlib.util.module_from_spec(spec)
spec.loader.exec_module(exported)

INNER = {"cli", "core", "kernel", "papers", "plot", "scenario", "simulate"}  # not for import by their names, or figures


def packages():
    named = {path.parent.name for path in (ROOT / "diffabs").glob("*/__init__.py")} - INNER
    return {"diffabs", *(f"diffabs.{name}" for name in named)}


def pages():
    return {path: path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md")}


def test_every_package_is_in_the_reference():
    marks = [mark for text in pages().values() for mark in exported.MARK.findall(text)]
    assert set(marks) == packages()
    assert len(marks) == len(set(marks))


@pytest.mark.parametrize("package", sorted(packages()))
def test_every_exported_name_comes_from_where_it_is_defined(package):
    module = importlib.import_module(package)
    names = exported.exported(package)
    own = {name: getattr(value, "__module__", None) or "" for name, value in vars(module).items()}
    made = {name for name, home in own.items() if not name.startswith("_") and home.startswith(package)}
    assert made <= names.keys()
    for name, path in names.items():
        home, _, last = path.rpartition(".")
        assert getattr(importlib.import_module(home), last) is getattr(module, name)


def test_a_mark_becomes_the_names():
    text = exported.on_page_markdown("before\n\n<!-- exported: diffabs.stops -->\n", page=None)
    assert text.startswith("before\n\n::: diffabs.stops.stops.")
    assert "::: diffabs.stops.stops.Standstill" in text
    with pytest.raises(ValueError, match="exports nothing"):
        exported.exported("diffabs.cli")


def test_every_page_is_in_the_navigation():
    said = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"^ +- ([\w/-]+\.md)$", said, re.MULTILINE))
    assert listed == {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}


@pytest.mark.skipif(shutil.which("mkdocs") is None, reason="mkdocs is in the group `docs`")
def test_the_site_builds_strictly(tmp_path):
    subprocess.run(["mkdocs", "build", "--strict", "--site-dir", tmp_path], cwd=ROOT, check=True, capture_output=True)
    assert "margins" in (tmp_path / "reference" / "linear" / "index.html").read_text()
