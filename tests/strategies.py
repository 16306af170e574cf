"""hypothesis strategies that several test files share."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray


def directions(*, lowest_z: float = 0.0) -> st.SearchStrategy[NDArray[np.float64]]:
    """Unit vectors (3,) with z at least `lowest_z`, pole and border included."""
    z = st.one_of(st.just(1.0), st.just(lowest_z), st.floats(lowest_z, 1.0))
    phi = st.one_of(st.sampled_from([0.0, np.pi / 2, np.pi]), st.floats(0, 2 * np.pi))

    def vector(z: float, phi: float) -> NDArray[np.float64]:
        radius = np.sqrt(max(0.0, 1 - z * z))
        return np.array([radius * np.cos(phi), radius * np.sin(phi), z])

    return st.builds(vector, z, phi)


def hemisphere() -> st.SearchStrategy[NDArray[np.float64]]:
    """Unit vectors on the upper hemisphere, horizon included."""
    return directions()


def sphere() -> st.SearchStrategy[NDArray[np.float64]]:
    """Unit vectors on the whole sphere."""
    return directions(lowest_z=-1.0)
