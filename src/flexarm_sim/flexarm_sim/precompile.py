"""Compiles the numba kernels into their cache, so that no node waits for it: ``python -m flexarm_sim.precompile``."""

import numpy as np

from flexarm_dynamics import arm_file, model

from .plant import Plant


def main():
    """Advance a plant by one period; numba keeps what it compiled for that."""
    plant = Plant(model.build(arm_file.load("R")), 1e-3)
    plant.advance(np.zeros(1))


if __name__ == "__main__":
    main()
