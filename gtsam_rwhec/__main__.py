"""``python -m gtsam_rwhec``: the command, where its script is not on the path."""

from gtsam_rwhec.cli import main

if __name__ == "__main__":
    main()
