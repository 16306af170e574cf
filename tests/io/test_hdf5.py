"""HDF5 captures: far and near, and what is refused of them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

import btfkit
from btfkit import directions, nearfield
from btfkit.cli import btfkit as program
from btfkit.cli.outcome import run as run_cli
from btfkit.errors import FormatError

N, H, W = 5, 12, 16


def capture(path: Path, **changes) -> Path:
    rng = np.random.default_rng(0)
    light = directions.normalize(np.column_stack([rng.uniform(-0.6, 0.6, (N, 2)), np.ones(N)]))
    view = directions.normalize(np.column_stack([rng.uniform(-0.6, 0.6, (N, 2)), np.ones(N)]))
    parts = {
        "ground_light": light[:, :2].astype("f4"),
        "ground_camera_dir": view[:, :2].astype("f4"),
        "ground_color": rng.uniform(-0.01, 2, (N, H, W, 3)).astype("f4"),
    }
    with h5py.File(path, "w") as file:
        for name, value in {**parts, **changes}.items():
            if value is not None:
                file[name] = value
    return path


def near(position: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """(n, h, w, 2) x and y of the rays from texels of 1 mm to positions."""
    x, y = nearfield.texel_places(np.arange(H)[:, None], np.arange(W), (H, W), 1.0)
    rays = directions.normalize(
        position[:, None, None] - np.stack(np.broadcast_arrays(x, y, 0.0), -1)
    )
    rng = np.random.default_rng(3)
    return (rays[..., :2] + noise * rng.standard_normal((*rays.shape[:3], 2))).astype("f4")


def test_images_and_directions_are_what_is_stored_and_read_by_parts(tmp_path):
    path = capture(tmp_path / "a.hdf5")
    btf = btfkit.open(path)
    with h5py.File(path) as file:
        colour, light = file["ground_color"][...], file["ground_light"][...]
    assert btf.shape == (N, H, W, 3)
    np.testing.assert_array_equal(btf.texture(3), colour[3])
    np.testing.assert_allclose(btf.light[:, :2], light, atol=1e-6)
    part = btf.crop(slice(2, 9), slice(1, 8)).crop(slice(1, 4), slice(2, 5))
    np.testing.assert_array_equal(part.texture(1), colour[1, 3:6, 3:6])
    assert btf.light_position is None
    down = btfkit.open(path, orientation="y_down")
    np.testing.assert_allclose(down.view, btf.view * [1, -1, 1], atol=1e-6)


@pytest.mark.parametrize("name", ["ground_camera_dir", "ground_light"])
def test_directions_for_each_texel_become_the_position_they_meet_in(name, tmp_path):
    rng = np.random.default_rng(1)
    position = np.column_stack([rng.uniform(-30, 30, (N, 2)), rng.uniform(20, 80, N)])
    # One of them far away: its rays are parallel to rounding.
    position[2] = [2e6, 1e6, 4e6]
    btf = btfkit.open(capture(tmp_path / "a.h5", **{name: near(position)}), texel_mm=1.0)
    kind = "view" if name == "ground_camera_dir" else "light"
    found = getattr(btf, f"{kind}_position")
    close = np.arange(N) != 2
    # Rays are stored to 1e-7; a position is as many times further than the sample is wide.
    np.testing.assert_allclose(found[close], position[close], rtol=1e-4, atol=1e-2)
    at = getattr(btf, f"{kind}_at")
    for pair in range(N):
        np.testing.assert_allclose(at(pair)[..., :2], near(position)[pair], atol=2e-4)
    stated = btf.provenance[f"{kind}_residual_deg"]
    assert stated["largest"] < 0.02
    assert stated["mean"] <= stated["largest"]


def test_directions_that_meet_in_no_point_are_refused_until_more_is_allowed(tmp_path, capsys):
    position = np.tile([5.0, -8.0, 60.0], (N, 1)) + np.arange(N)[:, None]
    path = capture(tmp_path / "a.hdf5", ground_camera_dir=near(position, noise=3e-3))
    with pytest.raises(
        FormatError,
        match=r"image \d: the views of its texels are up to 0\.\d+ degrees off from any one position; expected 0.2 at most; --direction-residual raises it",
    ):
        btfkit.open(path)
    btf = btfkit.open(path, direction_residual=2.0)
    assert 0.3 < btf.provenance["view_residual_deg"]["largest"] < 2
    assert btf.provenance["options"]["direction_residual"] == 2.0
    out = tmp_path / "a.btf.zarr"
    assert run_cli(program, ["ingest", str(path), "-o", str(out), "--no-preview"]) == 1
    assert "--direction-residual" in capsys.readouterr().err
    asked = ["ingest", str(path), "-o", str(out), "--no-preview", "--direction-residual", "2"]
    assert run_cli(program, asked) == 0
    np.testing.assert_allclose(btfkit.open(out).view_position, btf.view_position)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"ground_light": None},
            "no dataset ground_light; it holds ground_camera_dir, ground_color",
        ),
        (
            {"ground_color": np.zeros((N, H, W, 3), "u1")},
            "ground_color holds uint8; expected floating point",
        ),
        (
            {"ground_color": np.zeros((N, H, W), "f4")},
            r"ground_color has shape \(5, 12, 16\); expected 4 axes",
        ),
        ({"ground_color": np.zeros((N, H, W, 2), "f4")}, r"expected \(n, h, w, 3\)"),
        (
            {"ground_light": np.zeros((N + 1, 2), "f4")},
            r"ground_light has shape \(6, 2\); expected \(5, 2\)",
        ),
        (
            {"ground_light": np.zeros((N, 3), "f4")},
            r"ground_light has shape \(5, 3\); expected \(5, 2\)",
        ),
        (
            {"ground_light": np.full((N, 2), 0.9, "f4")},
            "the light of image 0 is .*; expected x, y of a unit vector",
        ),
        ({"ground_camera_dir": np.full((N, 2), np.nan, "f4")}, "the view of image 0 is"),
        ({"ground_camera_dir": np.zeros((N, H, W + 1, 2), "f4")}, "ground_camera_dir has shape"),
        (
            {"ground_light": h5py.SoftLink("/ground_camera_dir")},
            "ground_light is a link or a group",
        ),
        (
            {"ground_light": h5py.ExternalLink("other.hdf5", "/x")},
            "cannot be read|is a link|no dataset",
        ),
    ],
)
def test_what_is_not_understood_is_refused_by_name(changes, message, tmp_path):
    path = capture(tmp_path / "a.hdf5", **changes)
    with pytest.raises(FormatError, match=message) as caught:
        btfkit.open(path)
    assert "a.hdf5" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_values_in_other_files_and_values_that_never_were_are_refused(tmp_path):
    path = capture(tmp_path / "a.hdf5", ground_color=None)
    (tmp_path / "raw").write_bytes(bytes(4 * N * H * W * 3))
    with h5py.File(path, "a") as file:
        file.create_dataset(
            "ground_color", (N, H, W, 3), "f4", external=[("raw", 0, h5py.h5f.UNLIMITED)]
        )
    with pytest.raises(FormatError, match="ground_color lies in other files"):
        btfkit.open(path)
    path = capture(tmp_path / "b.hdf5", ground_color=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("ground_color", (N, H, W, 3), "f4")
    with pytest.raises(FormatError, match="ground_color was declared and never written"):
        btfkit.open(path)
    path = capture(tmp_path / "c.hdf5", ground_color=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("ground_color", (N, 100000, 100000, 3), "f4", chunks=(1, 8, 8, 3))
    with pytest.raises(FormatError, match=r"images of 100000 x 100000 texels|never written"):
        btfkit.open(path)
