"""``python -m sb3_fedguide``: the same as the console script ``fedguide``."""

from sb3_fedguide.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
