"""``python -m avatar VERB``: the console command, for an environment that is not activated."""

from avatar.cli import main

if __name__ == "__main__":
    main()
