"""Our own planner with its defaults, the table known: from points of the whole true surface."""

from run_torchgrasp import main

if __name__ == "__main__":
    main(whole=True)
