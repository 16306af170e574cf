"""`python -m btfkit`: the command, for programs that start Python modules."""

from btfkit.cli import main

if __name__ == "__main__":
    main()
