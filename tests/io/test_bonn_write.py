"""Writing Bonn `.btf`: truncation as good as the best, bounded memory, whole files or none."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import sources

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.cli import btfkit as verbs
from btfkit.cli.outcome import run
from btfkit.io.bonn import rows as bonn_rows
from btfkit.io.bonn import write as bonn_write
from btfkit.io.bonn.sketch import Sketch
from btfkit.relief.synth import synth_btf
from btfkit.textures import Array, Textures


def made(
    *, lights: int = 12, views: int = 9, size: tuple[int, int] = (16, 18), noise: float = 0.05
) -> BTF:
    """A full product in shuffled order: cosines, a gloss that moves, texture, noise."""
    rng = np.random.default_rng(0)
    table = directions.bonn81()[5:]
    pairs = rng.permutation([(i, j) for i in range(lights) for j in range(views)])
    light, view = table[pairs[:, 0]], table[7 + pairs[:, 1]]
    half = directions.normalize(light + view)
    row, col = np.indices(size)
    slope = np.stack([np.sin(col), np.cos(row), np.full(size, 6.0)], axis=-1)
    normal = directions.normalize(slope)
    gloss = np.einsum("hwi,ni->nhw", normal, half) ** 40
    albedo = 0.2 + 0.6 * rng.random((*size, 3))
    values = albedo * light[:, 2, None, None, None] + gloss[..., None]
    values = values * np.exp(noise * rng.standard_normal(values.shape))
    return BTF(textures=values.astype(np.float32), light=light, view=view, texel_mm=0.1)


def in_file_order(btf: BTF, back: BTF) -> np.ndarray:
    """Images of `btf` in the order that `back` has them."""
    match = [
        int(np.argmax(btf.light @ back.light[i] + btf.view @ back.view[i]))
        for i in range(len(back))
    ]
    assert sorted(match) == list(range(len(btf)))
    return btf.textures.batch(match)


def images(btf: BTF) -> np.ndarray:
    return btf.textures.batch(range(len(btf)))


def logs(values: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(values, 0) + 1e-5)


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


@pytest.mark.parametrize("rank", [1, 5, 40])
def test_no_factorisation_of_that_rank_is_closer(tmp_path: Path, rank: int) -> None:
    btf = made()
    written = bonn_write.write(btf, tmp_path / "a.btf", rank=rank, scalar=4, drr=True)
    back = btfkit.open(tmp_path / "a.btf")
    wanted = logs(in_file_order(btf, back))
    found = logs(images(back))
    matrix = wanted.transpose(0, 3, 1, 2).reshape(-1, 16 * 18).astype(np.float64)
    singular = np.linalg.svd(matrix, compute_uv=False)
    best = np.sqrt(np.sum(singular[rank:] ** 2) / matrix.size)
    assert written.components == (rank,)
    # Subspace iteration with twelve more vectors loses little even where, as at rank 40 here, the
    # spectrum is flat noise that no vector stands out of.
    assert best * 0.9999 <= written.rms[0] <= 1.02 * best
    # The file holds what was promised, up to float32.
    assert rms(found - wanted) == pytest.approx(written.rms[0], rel=2e-3)
    np.testing.assert_allclose(back.light[:, 2].max(), btf.light[:, 2].max(), atol=1e-6)
    assert back.texel_mm == pytest.approx(0.1)
    assert back.provenance["cosine_in_data"] is True
    assert back.provenance["dynamic_range_reduction"] is True


def test_hard_shadows_survive_the_defaults(tmp_path: Path) -> None:
    btf = synth_btf("cobbles", size=24, lights="13", views="9", samples=2)
    errors = {}
    for drr in (False, True):
        bonn_write.write(btf, tmp_path / "a.btf", rank=24, drr=drr, force=True)
        back = btfkit.open(tmp_path / "a.btf")
        errors[drr] = rms(images(back) - in_file_order(btf, back))
    # A shadow's logarithm is -11.5: it owns the components, and light comes back wrong.
    assert errors[False] < 0.3 * errors[True]
    bonn_write.write(btf, tmp_path / "a.btf", rank=24, force=True)
    back = btfkit.open(tmp_path / "a.btf")
    assert rms(images(back) - in_file_order(btf, back)) == errors[False]


@pytest.mark.parametrize("error", [0.3, 0.06, 0.03, 1e-3])
def test_an_error_is_met_with_no_more_components_than_it_takes(
    tmp_path: Path, error: float
) -> None:
    btf = made()
    written = bonn_write.write(btf, tmp_path / "a.btf", error=error, scalar=4, drr=True)
    back = btfkit.open(tmp_path / "a.btf")
    wanted = logs(in_file_order(btf, back))
    assert rms(logs(images(back)) - wanted) <= error * 1.001
    matrix = wanted.transpose(0, 3, 1, 2).reshape(-1, 16 * 18).astype(np.float64)
    singular = np.linalg.svd(matrix, compute_uv=False)
    tails = np.sqrt(np.cumsum(singular[::-1] ** 2)[::-1] / matrix.size)
    least = int(np.flatnonzero(np.append(tails[1:], 0) <= error)[0]) + 1
    assert least <= written.components[0] <= least + 1


# Half numbers have 11 bits; logarithms reach -11.5 and log-chroma 11.5, in a sum of components.
TOLERANCE = {0: 4e-3, 1: 4e-3, 3: 4e-3, 4: 4e-3, 5: 2e-2, 9: 6e-3, 10: 2e-2, 11: 2e-2, 12: 1e-2}


@pytest.mark.parametrize("model", TOLERANCE)
def test_every_colour_model_that_is_written_reads_back(tmp_path: Path, model: int) -> None:
    btf = made(lights=6, views=5)
    bonn_write.write(btf, tmp_path / "a.btf", kind="dfmf", colour_model=model, rank=64)
    back = btfkit.open(tmp_path / "a.btf")
    expected = in_file_order(btf, back)
    assert back.provenance["kind"] == "dfmf"
    np.testing.assert_allclose(images(back), expected, atol=TOLERANCE[model])


def test_dfmf_needs_fewer_bytes_for_chroma_than_for_luma(tmp_path: Path) -> None:
    written = bonn_write.write(made(), tmp_path / "a.btf", kind="dfmf", error=0.05)
    luma, *chroma = written.components
    assert max(chroma) < luma
    assert max(written.rms) <= 0.05


@pytest.mark.parametrize("scalar", [2, 4, 8])
def test_scalars_of_every_size_are_written(tmp_path: Path, scalar: int) -> None:
    btf = made(lights=4, views=3)
    bonn_write.write(btf, tmp_path / "a.btf", scalar=scalar, rank=36, drr=False)
    back = btfkit.open(tmp_path / "a.btf")
    expected = in_file_order(btf, back)
    np.testing.assert_allclose(images(back), expected, atol={2: 4e-3, 4: 1e-5, 8: 1e-5}[scalar])


def test_any_number_of_channels_is_written_with_their_names(tmp_path: Path) -> None:
    for names in (("Y",), ("450", "550", "650", "750")):
        btf = sources.small_btf(channels=names)
        bonn_write.write(btf, tmp_path / "a.btf", force=True)
        back = btfkit.open(tmp_path / "a.btf")
        assert back.channels == names
        np.testing.assert_allclose(images(back), in_file_order(btf, back), rtol=3e-3)
    with pytest.raises(ValueError, match="colour model YUV has 3 channels; the BTF has 4"):
        bonn_write.write(btf, tmp_path / "b.btf", kind="dfmf", colour_model="yuv")


def test_missing_pairs_are_named(tmp_path: Path) -> None:
    btf = made(lights=4, views=3)
    gone = btf.subset(np.arange(12) != 5)
    with pytest.raises(ValueError, match=r"of 4 x 3 pairs 1 are missing, the first light \(") as e:
        bonn_write.write(gone, tmp_path / "a.btf")
    theta, phi = np.degrees(directions.to_angles(btf.light[5]))
    assert f"light ({theta:.4g}, {phi:.4g}) view (" in str(e.value)
    assert list(tmp_path.iterdir()) == []
    twice = btf.subset([*range(12), 5])
    with pytest.raises(ValueError, match="1 are there more than once"):
        bonn_write.write(twice, tmp_path / "a.btf")


def test_values_that_are_not_measured_are_refused(tmp_path: Path) -> None:
    btf = sources.small_btf()
    values = images(btf)
    values[2, 1, 1] = np.nan
    holed = BTF(textures=values, light=btf.light, view=btf.view)
    with pytest.raises(ValueError, match="image 2 has values that are not measured"):
        bonn_write.write(holed, tmp_path / "a.btf")
    mask = np.ones((1, *btf.shape[1:3]), bool)
    mask[0, 0, 0] = False
    masked = BTF(textures=images(btf), light=btf.light, view=btf.view, validity=mask)
    with pytest.raises(ValueError, match="image 0 has values that are not measured"):
        bonn_write.write(masked, tmp_path / "a.btf")


def test_negative_values_are_counted_where_logarithms_lose_them(tmp_path: Path) -> None:
    btf = sources.small_btf()
    values = images(btf)
    values[2, 1, 1] = -0.25
    below = BTF(textures=values, light=btf.light, view=btf.view)
    with pytest.warns(UserWarning, match="3 negative values were written as 0"):
        bonn_write.write(below, tmp_path / "a.btf", scalar=4, drr=True)
    back = btfkit.open(tmp_path / "a.btf")
    expected = np.maximum(in_file_order(below, back), 0)
    np.testing.assert_allclose(images(back), expected, atol=1e-5)
    bonn_write.write(below, tmp_path / "b.btf", drr=False, scalar=4)
    back = btfkit.open(tmp_path / "b.btf")
    np.testing.assert_allclose(images(back), in_file_order(below, back), atol=1e-5)


def test_values_beyond_half_numbers_ask_for_wider_ones(tmp_path: Path) -> None:
    btf = sources.small_btf()
    bright = BTF(textures=images(btf) * 1e5, light=btf.light, view=btf.view)
    with pytest.raises(ValueError, match=r"2-byte numbers hold up to 6.55e\+04: .*scalar=4"):
        bonn_write.write(bright, tmp_path / "a.btf", drr=False)
    assert list(tmp_path.iterdir()) == []
    bonn_write.write(bright, tmp_path / "a.btf", drr=False, scalar=4)
    back = btfkit.open(tmp_path / "a.btf")
    np.testing.assert_allclose(images(back), in_file_order(bright, back), rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "pvf"}, "kind 'pvf'; expected fmf or dfmf"),
        ({"rank": 0}, "rank 0; expected 1 to 1024"),
        ({"error": -1.0}, "error -1.0; expected a positive"),
        ({"rank": 3, "error": 0.1}, "both rank and error are given"),
        ({"scalar": 3}, "scalar 3; expected 2, 4 or 8 bytes"),
        ({"kind": "dfmf", "colour_model": "cmyk"}, "no colour model 'cmyk'; there are RGB"),
        ({"kind": "dfmf", "colour_model": "LAB"}, "colour model LAB is only read; written are"),
    ],
)
def test_options_without_sense_are_refused(
    tmp_path: Path, options: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        bonn_write.write(sources.small_btf(), tmp_path / "a.btf", **options)
    assert list(tmp_path.iterdir()) == []


def test_equal_seeds_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.btf", "b.btf"):
        bonn_write.write(made(), tmp_path / name, rank=4)
    assert (tmp_path / "a.btf").read_bytes() == (tmp_path / "b.btf").read_bytes()


class Endless(Textures):
    """Many images made when they are asked for: 79 MB if they were all kept."""

    reads = 0

    def __init__(self, pairs: int) -> None:
        self.shape = (pairs, 64, 64, 3)
        rng = np.random.default_rng(0)
        self._basis = rng.random((4, 64, 64, 3), np.float32)

    def _read(self, index: int) -> Array:
        self.reads += 1
        weights = np.cos(index * np.arange(1, 5, dtype=np.float32)) ** 2
        return np.einsum("k,khwc->hwc", weights, self._basis)


@pytest.mark.slow
def test_memory_is_bounded_by_factors_and_a_block_of_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bonn_rows, "_AT_ONCE", 1 << 20)
    monkeypatch.setattr(bonn_rows, "_KEPT", 0)
    table = directions.bonn81()[:40]
    light, view = np.tile(table, (40, 1)), np.repeat(table, 40, axis=0)
    btf = BTF(textures=Endless(len(light)), light=light, view=view)
    assert 4 * np.prod(btf.shape) > 78e6
    tracemalloc.start()
    bonn_write.write(btf, tmp_path / "a.btf", rank=8)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Some copies of a block of 1 MB in work, and 20 vectors of 4800 rows and 4096 texels.
    assert peak < 8e6
    assert len(btfkit.open(tmp_path / "a.btf")) == 1600


def test_a_small_btf_is_read_once_and_a_large_one_once_a_pass_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = directions.bonn81()[:6]
    light, view = np.tile(table, (6, 1)), np.repeat(table, 6, axis=0)
    monkeypatch.setattr(bonn_rows, "_AT_ONCE", 1 << 18)
    reads = []
    for kept in (1 << 29, 0):
        monkeypatch.setattr(bonn_rows, "_KEPT", kept)
        textures = Endless(36)
        btf = BTF(textures=textures, light=light, view=view)
        bonn_write.write(btf, tmp_path / f"{kept}.btf", rank=3)
        reads.append(textures.reads)
    assert reads == [36, 3 * 36]
    assert (tmp_path / "0.btf").read_bytes() == (tmp_path / f"{1 << 29}.btf").read_bytes()


def test_tracked_vectors_grow_without_losing_those_found() -> None:
    rng = np.random.default_rng(0)
    matrix = (rng.standard_normal((40, 6)) @ rng.standard_normal((6, 30))).astype(np.float32)
    sketch = Sketch(40, 30, 3, rng)
    for width in (3, 10):
        sketch.grow(width)
        for _ in range(3):
            sketch.begin()
            sketch.absorb(matrix)
            sketch.turn()
    # Orthonormal up to float32.
    np.testing.assert_allclose(sketch.v.T @ sketch.v, np.eye(10), atol=1e-5)
    sketch.begin_projection()
    sketch.project(matrix[:25])
    sketch.project(matrix[25:])
    residuals = sketch.residuals()
    u, s, v = sketch.factors(6)
    np.testing.assert_allclose(u @ v.T, matrix, atol=1e-4)
    np.testing.assert_allclose(s, np.linalg.svd(matrix, compute_uv=False)[:6], rtol=1e-4)
    # float32 of values up to 10.
    assert residuals[5] < 1e-5 < residuals[4]


def test_convert_writes_a_btf_and_info_knows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, out = str(sources.SOURCES["zarr"](tmp_path)), str(tmp_path / "a.btf")
    settings = ["--set", "kind=dfmf", "--set", "rank=4", "--set", "colour_model=YUV"]
    assert run(verbs, ["convert", store, "-o", out, "--as", "btf", *settings, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["format"] == "btf"
    assert run(verbs, ["info", out, "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["provenance"]["colour_model"] == "YUV"
    assert said["provenance"]["components"] == [4, 4, 4]
