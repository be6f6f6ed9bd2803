"""A scenario in the browser: sliders change its numbers, and curves, fan, poles and verdict follow.

`session` is the whole computation without a page. `server` shows it and needs the extra `explore`.
"""
