"""Proofs: gains and certificates by linear matrix inequalities, and bounds of every run and every margin of a box.

`design` needs the extra `design`, and `reach` a C++ compiler. The ring imports `linear` and what is below it.

Read first: `design/synthesis.py`, `design/analysis.py`, `reach/cover.py`, `frequency/sensitivity.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.robust import design as design
    from diffabs.robust import frequency as frequency
    from diffabs.robust import reach as reach

__getattr__ = lazy_getattr(__name__)
