"""A scenario in the browser: numbers are dragged, and curves, a fan, poles and a verdict follow.

`session` is the whole computation, without a page; `server` shows it, and needs the extra `explore`."""
