import sys

from hybridjax.apps.cli import main


if __name__ == "__main__":
    sys.exit(main())
