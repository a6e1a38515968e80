"""`python -m torchgrasp`: the command line."""

from torchgrasp.app.cli import run_and_exit

if __name__ == "__main__":
    run_and_exit()
