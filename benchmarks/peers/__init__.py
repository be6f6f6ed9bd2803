"""One problem, one error, one clock; every program that solves it in a process of its own."""
