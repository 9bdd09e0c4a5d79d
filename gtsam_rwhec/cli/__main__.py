"""``python -m gtsam_rwhec.cli``: the command, where its script is not on the path."""

from gtsam_rwhec.cli.app import main

if __name__ == "__main__":
    main()
