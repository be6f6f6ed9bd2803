"""The list of mutations is true: each file, text and test that it names exists."""

import ast
import pathlib

import pytest
from mutations import MUTATIONS

ROOT = pathlib.Path(__file__).parent.parent


def defined(file):
    """Names of the tests in a file, those in classes as Class::test."""
    tree = ast.parse((ROOT / "tests" / file).read_text())
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
    return names | {f"{c.name}::{f.name}" for c in classes for f in c.body if isinstance(f, ast.FunctionDef)}


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_a_mutation_finds_its_text_and_its_test(mutation):
    source = (ROOT / "diffabs" / mutation.file).read_text()
    assert mutation.old in source, f"{mutation.old!r} in {mutation.file}"
    assert mutation.old != mutation.new
    file, _, test = mutation.test.partition("::")
    assert not test or test.partition("[")[0] in defined(file)
