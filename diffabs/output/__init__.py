"""What leaves the package: figures, reports, exported code, and the explorer in the browser.

Each room needs the extra of its name. The ring imports all below it; only `plot` knows matplotlib, and only `explore` a
web framework.

Read first: `plot/runs.py`, `report/writing.py`, `export/c99.py`, `explore/session.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.output import explore as explore
    from diffabs.output import export as export
    from diffabs.output import plot as plot
    from diffabs.output import report as report

__getattr__ = lazy_getattr(__name__)
