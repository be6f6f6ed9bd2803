"""Sweep folders and certificates, changed at random, read by everything that reads them.

    python tests/support/fuzz_files.py --count 2000 --seed 0

Nothing may end in a traceback, hang, give other numbers than were written, or prove what is not true. Half of the
mutations are of folders, half of certificates; each is a function of the seed and its number, which is printed with
whatever goes wrong (`--only N` repeats it). Exit status 1 if something did."""

import argparse
import collections
import pathlib
import random
import signal
import sys
import tempfile
import traceback

PATIENCE = 120  # s for one mutation
JSON = (None, True, False, 0, -1, 1, 3, 2**64, 0.0, -0.0, -1e9, 1e-320, 1e308, float("nan"), float("inf"), "", "x")
JSON += ("\ud800", "\n", [], [1], [[]], {}, {"type": "normal"}, {"A": 1})


def in_a_line(error):
    """What became of a mutation that was refused as it should be."""
    assert "\n" not in str(error), error
    return "refused in a line"


def any_value(rng, there):
    """A value of JSON in the place of another one, often near it."""
    if isinstance(there, float | int) and not isinstance(there, bool) and rng.random() < 0.6:
        return rng.choice([-there, 2 * there, there / 2, there * (1 + rng.gauss(0, 0.1)), there + rng.gauss(0, 1), 0.0])
    if rng.random() < 0.05:
        deep = there
        for _ in range(rng.choice([2, 60, 900])):
            deep = [deep] if rng.random() < 0.5 else {"type": deep}
        return deep
    return rng.choice(JSON)


def places(value, at=()):
    """The paths of all values in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*at, key)
        yield from places(item, (*at, key))


def edited(rng, document):
    """A document in which a value was changed, removed, added, doubled or exchanged with another. What changed."""
    path = rng.choice(list(places(document)))
    *above, key = path
    node = document
    for step in above:
        node = node[step]
    how = rng.choice(["change", "change", "change", "remove", "add", "double", "exchange"])
    if how == "remove":
        del node[key]
    elif how == "add":
        node.append(any_value(rng, node[key])) if isinstance(node, list) else node.update(more=any_value(rng, 1.0))
    elif how == "double" and isinstance(node, list):
        node.insert(key, node[key])
    elif how == "exchange":
        other = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
        node[key], node[other] = node[other], node[key]
    else:
        node[key] = any_value(rng, node[key])
    return f"{how} {'.'.join(map(str, path))}"


def damaged(rng, data):
    """Bytes of which some were changed. What changed."""
    if not data:
        return b"x", "one byte"
    at, how = rng.randrange(len(data)), rng.choice(["flip", "flip", "flip", "cut", "longer", "zeros", "shuffled"])
    if how == "flip":
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :], f"flip in byte {at}"
    if how == "cut":
        return data[:at], f"cut at {at}"
    if how == "longer":
        return data + data[at:], "longer"
    end = min(len(data), at + rng.randrange(1, 200))
    part = bytes(end - at) if how == "zeros" else bytes(rng.sample(list(data[at:end]), end - at))
    return data[:at] + part + data[end:], f"{how} {at} to {end}"


def one(target, seed, number, tally):
    """A mutation and what became of it. What went wrong, or None."""
    rng = random.Random(f"{seed}/{number}")
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("it hangs")))
    signal.alarm(PATIENCE)
    what = "before it was changed"
    try:
        with tempfile.TemporaryDirectory() as room:
            what, read = target(rng, pathlib.Path(room))
            for reader, outcome in read:
                tally[reader, outcome] += 1
        return None
    except Exception as error:
        what = getattr(error, "mutation", what)
        return f"{number}: {what}: {traceback.format_exc() if '-v' in sys.argv else repr(error)[:300]}"
    finally:
        signal.alarm(0)


def fuzz(count, seed, only=None, outsiders=True):
    """Failures, a line each; and how often each reader did what."""
    from fuzz_certificates import Certificates
    from fuzz_sweeps import Folders

    tally, failures = collections.Counter(), []
    with tempfile.TemporaryDirectory() as room:
        targets = (Folders(pathlib.Path(room)), Certificates(outsiders))
        for number in range(count) if only is None else [only]:
            if failure := one(targets[number % 2], seed, number, tally):
                failures.append(failure)
    return failures, tally


def main():
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument("--no-outsiders", action="store_true", help="without check_certificate.py")
    parser.add_argument("-v", action="store_true", help="whole tracebacks")
    given = parser.parse_args()
    failures, tally = fuzz(given.count, given.seed, given.only, not given.no_outsiders)
    for (reader, outcome), times in sorted(tally.items()):
        print(f"{reader:28} {outcome:28} {times}")
    print(*failures, f"{given.count} mutations, {len(failures)} failures", sep="\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
