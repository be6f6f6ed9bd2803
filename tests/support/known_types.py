"""The share of the public symbols whose types a checker knows: it may only rise.

python tests/support/known_types.py             fails below the stored share, and names the symbols that lost theirs
python tests/support/known_types.py --store     stores share and symbols, if the share has not fallen
"""

import json
import os
import pathlib
import subprocess
import sys

STORED = pathlib.Path(__file__).with_suffix(".json")
COMMAND = [sys.executable, "-m", "pyright", "--verifytypes", "diffabs", "--ignoreexternal", "--outputjson"]
# pyright reads the packages of the first Python of PATH.
ENVIRONMENT = os.environ | {"PATH": os.pathsep.join([str(pathlib.Path(sys.executable).parent), os.environ["PATH"]])}
DIGITS = 4


def measure() -> tuple[float, list[str]]:
    """Return the share of public symbols with a known type, and the names of the others."""
    report = subprocess.run(COMMAND, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    types = json.loads(report.stdout)["typeCompleteness"]
    untyped = {symbol["name"] for symbol in types["symbols"] if symbol["isExported"] and not symbol["isTypeKnown"]}
    return round(types["completenessScore"], DIGITS), sorted(untyped)


def main() -> None:
    """Compare with what is stored."""
    share, untyped = measure()
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    print(f"{share:.2%} of the public symbols have known types; stored: {stored['share']:.2%}")
    if share < stored["share"]:
        print("These lost theirs:", *sorted(set(untyped) - set(stored["untyped"])), sep="\n  ")
        sys.exit(1)
    if "--store" in sys.argv[1:]:
        STORED.write_text(json.dumps({"share": share, "untyped": untyped}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
