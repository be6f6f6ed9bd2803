"""`python -m diffabs`."""

from diffabs.cli import main

if __name__ == "__main__":
    main()
