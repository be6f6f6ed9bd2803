"""The command line program, as `python -m diffabs`."""

from diffabs.cli.main import main

if __name__ == "__main__":
    main()
