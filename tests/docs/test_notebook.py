"""The notebook of the examples runs, and its cells show tables, a figure and a line of progress."""

import warnings

import numpy as np
import pytest
from project import ROOT

nbclient = pytest.importorskip("nbclient", reason="nbclient is in the group `ecosystem`")
pytest.importorskip("ipykernel", reason="ipykernel is in the group `ecosystem`")
NOTEBOOK = ROOT / "examples" / "first-hour.ipynb"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """What each cell of code shows: the kinds of its data, and its texts."""
    import nbformat

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the event loop of zmq
        notebook = nbformat.read(NOTEBOOK, as_version=4)
        assert not any("matplotlib" in cell.source for cell in notebook.cells)
        folder = tmp_path_factory.mktemp("notebook")
        nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}}).execute()
    cells = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]
    return [[output.data for output in shown if "data" in output] for shown in cells]


def test_cells_show_tables_a_figure_and_progress(outputs):
    loop, run, figure, batch, runs, tuned, _ = outputs
    for table, *more in (loop, run, batch, runs, tuned[-1:]):
        assert "<table>" in table["text/html"]
        assert not more
    assert len(figure) == 1
    assert len(figure[0]["image/png"]) > 10_000
    assert tuned[0]["text/plain"].startswith("tuning: iteration ")
    assert len(tuned) == 2  # one line, which has changed in place


def test_the_tuned_slip_is_that_of_the_greatest_friction(outputs):
    """A wheel that stops soonest brakes near the peak of the road at a middle speed."""
    ((pair,),) = outputs[-1:]
    tuned, peak = map(float, pair["text/plain"].strip("()").split(","))
    np.testing.assert_allclose(tuned, peak, rtol=0.15)  # the peak moves with the speed, from 100 to 5 km/h
