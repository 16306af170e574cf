"""NeuBTF with heights: what is taught, what is kept from it, and what a guidance becomes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import btfkit
from btfkit import propagation
from btfkit.btf import BTF
from btfkit.errors import FitError, FormatError
from btfkit.fitting import fit, loop, training
from btfkit.fitting.neubtf import augment, carrier, copying, muon, windows
from btfkit.fitting.neubtf import encoder as encoders
from btfkit.fitting.neubtf import paper as published
from btfkit.fitting.neubtf import trainable as neubtf
from btfkit.fitting.neubtf.data import frontal_slice
from btfkit.fitting.neubtf.encoder import STRIDE, Encoder
from btfkit.fitting.neumip.engines.device import OnDevice
from btfkit.footprint import gaussian
from btfkit.materials import file
from btfkit.materials.evaluation import texel_centres
from btfkit.materials.neubtf.material import NeuBTF
from btfkit.materials.neubtf.paper import NeuBTFPaper
from btfkit.relief.synth import synth_btf
from btfkit.synthesis import tile_neubtf

pytestmark = pytest.mark.slow

TINY: dict[str, str] = {"batch": "1024"}
STEPS = 160
# Nothing but the encoder says what is carried.
UNTIED = TINY | {"tied": "0", "free": "0.6"}
UNTIED_STEPS = 260


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def tiny() -> BTF:
    lazy = synth_btf("woven", size=32, lights="9", views="9", samples=2)
    return replace(lazy, textures=lazy.textures.batch(range(len(lazy))))


@pytest.fixture(scope="module")
def fitted(tiny: BTF, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("model") / "tiny.neubtf.safetensors"
    fit.fit(tiny, model="neubtf", steps=STEPS, out=out, settings=TINY)
    return out


@pytest.fixture(scope="module")
def untied(tiny: BTF, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("model") / "untied.neubtf.safetensors"
    fit.fit(tiny, model="neubtf", steps=UNTIED_STEPS, out=out, settings=UNTIED)
    return out


@pytest.fixture(scope="module")
def sharp(tiny: BTF) -> NeuBTF:
    """A material of good textures, whatever its encoder."""
    settings = TINY | {"free": "0.98", "kept": "false"}
    material = fit.fit(tiny, model="neubtf", steps=600, settings=settings, holdout=0.0).material
    assert isinstance(material, NeuBTF)
    return material


def begun(btf: BTF, **settings: str) -> neubtf.NeuBTF:
    n = len(btf)
    return neubtf.NeuBTF(
        btf, np.arange(n - 4), np.arange(n - 4, n), settings=TINY | settings,
        generators=loop.Generators(0),
    )  # fmt: skip


def guidance_of(btf: BTF) -> torch.Tensor:
    return augment.encoded(frontal_slice(btf, np.arange(len(btf))))[None]


# --- the encoder and what moves it ---------------------------------------------------------------


def test_the_encoder_moves_with_the_image_by_multiples_of_its_stride() -> None:
    encoder = Encoder(4, 7, generator()).eval()
    guide = torch.rand(1, 4, 32, 48, generator=generator())
    with torch.no_grad():
        shifted = encoder(guide.roll((STRIDE, 3 * STRIDE), (2, 3)))
        ours = encoder(guide).roll((STRIDE, 3 * STRIDE), (2, 3))
    # float32 sums in another order
    torch.testing.assert_close(shifted, ours, atol=1e-5, rtol=1e-4)
    with pytest.raises(ValueError, match=r"guidance of 12 x 16; expected multiples of 8"):
        encoder(torch.zeros(1, 4, 12, 16))


@pytest.mark.parametrize("wrap", [True, False])
def test_guidance_encoded_in_parts_is_guidance_encoded_whole(
    wrap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder = Encoder(4, 7, generator()).eval()
    guide = torch.rand(1, 4, 96, 144, generator=generator())
    with torch.no_grad():
        whole = encoders.encode_in_tiles(encoder, guide, wrap=wrap)
        monkeypatch.setattr(encoders, "_PART", 64)
        parts = encoders.encode_in_tiles(encoder, guide, wrap=wrap)
    # float32 sums in another order; a reach too short would show at parts' edges
    torch.testing.assert_close(parts, whole, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("shape", [(24, 144), (96, 72), (7, 7)])
def test_muon_moves_along_matrices_whose_singular_values_lie_near_one(
    shape: tuple[int, int],
) -> None:
    matrix = torch.randn(shape, generator=generator(), dtype=torch.float64)
    found = muon.orthogonalised(matrix)
    values = torch.linalg.svdvals(found)
    # the quintic of the source ends between 0.68 and 1.13 for all but the least values
    assert values.max() < 1.3
    assert values.median() > 0.6
    left, _, right = torch.linalg.svd(matrix, full_matrices=False)
    # same singular vectors: what is left beside the diagonal is rounding
    inner = left.T @ found @ right.T
    assert (inner - torch.diag(inner.diag())).abs().max() < 1e-6
    assert (muon.orthogonalised(torch.zeros(3, 4)) == 0).all()


# --- the two parts -------------------------------------------------------------------------------


def test_features_are_tied_to_the_colours_of_the_guidance(tiny: BTF) -> None:
    model = begun(tiny)
    wanted = carrier.tied_features(model._guidance, model._axes).numpy()
    # the first of the axes sees most of what varies
    assert wanted[..., 0].std() >= wanted[..., 1].std() > 0
    for index in range(6):
        model.step(0.3 * index / 5)
        features = model.material().weights["texture.0.0"]
        # float16
        np.testing.assert_allclose(features[..., 6:], wanted, atol=2e-3)


def test_a_quarter_is_kept_from_the_encoder_until_it_has_been_measured(tiny: BTF) -> None:
    model = begun(tiny)
    model.step(0.0)
    model.step(0.27)
    assert model._kept == (8, 8, 16, 16)
    aim = model._wanted
    assert aim is not None
    guide = whole(model._guides).draw()
    _, counts = model._lesson(guide, aim)
    assert counts.sum() == 32 * 32 - 16 * 16
    assert model.stated() == {}
    model.step(0.95)
    assert model.stated()["carried_window"] == [8, 8, 16, 16]
    _, counts = model._lesson(guide, aim)
    assert counts.sum() == 32 * 32
    small = tiny.crop(slice(0, 24), slice(0, 24))
    assert begun(small)._kept is None


def test_of_a_large_sample_a_part_tells_how_well_is_carried(
    tiny: BTF, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = begun(tiny)
    assert model._judged(windows.Window(8, 8, 16, 16)) == ((0, 0, 32, 32), (8, 8, 16, 16))
    monkeypatch.setattr(neubtf, "_MOST_SIDE", 12)
    part, window = model._judged(windows.Window(8, 8, 16, 16))
    # Beside the kept corner three quarters that the encoder has seen, to be copied from.
    assert (part, window) == ((2, 2, 12, 12), (8, 8, 6, 6))
    for progress in (0.0, 0.27, 0.95):
        model.step(progress)
    found = model.stated()
    assert found["carried_window"] == [8, 8, 6, 6]
    assert math.isfinite(found["psnr_carried"])


def test_a_part_of_a_material_answers_as_the_whole_does_there(tiny: BTF) -> None:
    model = begun(tiny)
    for index in range(30):
        model.step(0.2 * index / 30)
    material = model.free.material()
    part = windows.part_of(material, windows.Window(4, 6, 24, 20))
    light, view = [0.3, 0.2, 0.9], [0.0, 0.0, 1.0]
    all_of_it = material.evaluate(texel_centres(32, 32), light, view).reflectance
    some = part.evaluate(texel_centres(24, 20), light, view).reflectance
    # float16 heights of another scale move the places by 2^-11 of them; the border is another one.
    np.testing.assert_allclose(some[2:-2, 2:-2], all_of_it[6:26, 8:24], atol=2e-3)
    assert windows.part_of(material, windows.Window(0, 0, 32, 32)) is material


def whole(guides: Any) -> Any:
    """The same guides, unmoved."""
    guides._window = lambda: windows.Window(0, 0, 32, 32)
    return guides


def test_what_counts_for_the_answer_counts_in_the_teaching(tiny: BTF) -> None:
    model = begun(tiny)
    for index in range(30):
        model.step(0.2 * index / 30)
    layout = model.free.layout
    weights, _ = model.free.engine.parameters()
    _, decoder = layout.split(weights)
    # A decoder that does not read a feature: neither itself nor through a frame.
    layout.decoder.layers(decoder)[0][0][:, 1] = 0
    layout.decoder.layers(decoder)[0][0][:, 8:10] = 0
    model._aim()
    assert model._weight[2] < 1e-6
    assert (model._weight[[0, 4, 5, 6]] > 1e-5).all()
    torch.testing.assert_close(model._weight.sum(), torch.tensor(1.0))


def test_an_encoder_that_learns_nothing_shows_in_what_is_carried_and_not_in_its_own(
    tiny: BTF, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Copies alone carry something whatever is compared: random convolutions tell patches apart.
    settings = UNTIED | {"copied": "false", "turned": "0", "guessed": "0"}

    def errors() -> Any:
        return fit.fit(tiny, model="neubtf", steps=UNTIED_STEPS, settings=settings).errors

    good = errors()
    monkeypatch.setattr(neubtf.NeuBTF, "_optimise", lambda *_: None)
    failed = errors()
    assert failed["psnr_own"] == good["psnr_own"] == good["psnr"]
    # an encoder that gives the mean texture everywhere has lost all structure
    assert good["psnr_carried"] > failed["psnr_carried"] + 1


def test_a_corrupted_encoder_shows_in_an_evaluation(
    tiny: BTF, untied: Path, tmp_path: Path
) -> None:
    arrays = file.training_arrays(untied)
    name = "encoder.out.weight"
    arrays[name] = np.random.default_rng(0).permuted(arrays[name], axis=1)
    file.save(btfkit.load(untied), tmp_path / "bad.safetensors", training=arrays)
    test = btfkit.split(len(tiny))[1]
    good, bad = (
        propagation.errors_carried(path, tiny, pairs=test)
        for path in (untied, tmp_path / "bad.safetensors")
    )
    assert good["psnr_carried"] > bad["psnr_carried"] + 1
    # Onto itself nothing is copied: that would hide the encoder.
    assert set(good) == {"psnr_carried", "psnr_log1p_carried"}
    # The same quarter as in the report, from which nothing is copied, either.
    window = json.loads(untied.with_name("untied.neubtf.report.json").read_text())["carried_window"]
    good, bad = (
        propagation.errors_carried(path, tiny, pairs=test, window=window)
        for path in (untied, tmp_path / "bad.safetensors")
    )
    assert good["psnr_carried"] > bad["psnr_carried"] + 1


def test_eval_states_own_and_carried(
    tiny: BTF, fitted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from btfkit.cli import btfkit as group
    from btfkit.cli.outcome import run
    from btfkit.io.store import writer

    store = writer.write(tiny, tmp_path / "a.btf.zarr", dtype="float32")
    assert run(group, ["eval", str(fitted), str(store), "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["psnr_own"] == found["psnr"]
    assert found["carried_window"] == [8, 8, 16, 16]
    assert 10 < found["psnr_carried"] < 60


def test_equal_seed_and_steps_give_equal_bytes_and_resume_goes_the_same_way(
    tiny: BTF, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, again, part = (tmp_path / f"{name}.safetensors" for name in ("a", "b", "c"))
    for out in (whole, again):
        fit.fit(tiny, model="neubtf", steps=40, out=out, settings=TINY, seed=3)
    assert whole.read_bytes() == again.read_bytes()
    original, taken = neubtf.NeuBTF.step, [0]

    def stopping(self: Any, progress: float) -> float:
        taken[0] += 1
        if taken[0] == 25:
            raise KeyboardInterrupt
        return original(self, progress)

    monkeypatch.setattr(neubtf.NeuBTF, "step", stopping)
    report = fit.fit(tiny, model="neubtf", steps=40, out=part, settings=TINY, seed=3)
    assert report.interrupted
    monkeypatch.setattr(neubtf.NeuBTF, "step", original)
    fit.fit(tiny, model="neubtf", steps=40, out=part, settings=TINY, seed=3, resume=True)
    ours, theirs = file.training_arrays(whole), file.training_arrays(part)
    for name, array in (btfkit.load(whole).weights | ours).items():
        np.testing.assert_array_equal(array, (btfkit.load(part).weights | theirs)[name])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["neubtf", "sbtf"])
def test_on_a_device_the_same_is_trained_wherever_what_is_read_is_a_copy(
    model: str, tiny: BTF, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = TINY | {"guessed": "0"}
    # A GPU that is the CPU under another name, whose parameters are not the CPU's.
    for module in (training, fit):
        monkeypatch.setattr(module, "gpu", lambda: "cpu:0")
    read = OnDevice.parameters
    monkeypatch.setattr(OnDevice, "parameters", lambda self: tuple(a.copy() for a in read(self)))
    ours, theirs = (
        fit.fit(tiny, model=model, steps=24, device=device, settings=settings)
        for device in ("cuda", "cpu")
    )
    assert (ours.device, theirs.device) == ("cpu:0", "cpu")
    # Both sum in float32, in another order, 24 times.
    for name in ("psnr", *(["psnr_carried"] if model == "neubtf" else [])):
        assert ours.errors[name] == pytest.approx(theirs.errors[name], abs=0.1)
    one, two = (report.material.weights["texture.heights"] for report in (ours, theirs))
    np.testing.assert_allclose(one, two, atol=2e-3)
    if model == "neubtf":
        held = [report.material.weights["texture.0.0"][..., 6:] for report in (ours, theirs)]
        np.testing.assert_array_equal(held[0], held[1])


def test_group_24_no_steps_one_pair_one_texel_and_no_test_still_end_in_a_model(tiny: BTF) -> None:
    assert fit.fit(tiny, model="neubtf", steps=0).untrained
    assert fit.fit(tiny.subset([4]), model="neubtf", steps=6, settings=TINY).errors == {}
    texel = tiny.crop(slice(3, 4), slice(5, 6))
    for btf, options in ((texel, {}), (tiny, {"holdout": 0.0})):
        report = fit.fit(btf, model="neubtf", steps=6, settings=TINY, **options)
        uv = np.random.default_rng(0).random((9, 2))
        answer = report.material.evaluate(uv, [0.5, 0, 0.8], [0, 0.6, 0.8]).reflectance
        assert np.isfinite(answer).all()
        assert "psnr_carried" not in report.errors


def test_texels_that_are_not_measured_are_masked_and_counted(tiny: BTF) -> None:
    values = np.array(tiny.textures, np.float32)
    values[:, 3:9, 4:8] = np.nan
    report = fit.fit(replace(tiny, textures=values), model="neubtf", steps=24, settings=TINY)
    assert report.masked_texels >= 24 * (len(tiny) - 8)
    assert math.isfinite(report.errors["psnr_carried"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frontals": "3"}, r"no setting frontals \(did you mean frontal\?\); it has scales"),
        ({"precision": "int8"}, "precision = 'int8'; expected float16 or float32"),
        ({"free": "1"}, "free = 1.0; expected more than 0 and less than 1"),
        ({"tied": "3"}, "tied = 3; expected 0 to 2"),
        ({"turned": "1"}, "turned = 1.0; expected 0 to less than 1"),
        ({"rate": "0"}, "rate = 0.0; expected more than 0, up to 1"),
        ({"frontal": "2"}, "frontal = 2.0; expected 0 to 1"),
        ({"crop": "0"}, "crop and pool_mb must be at least 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    tiny: BTF, given: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        fit.fit(tiny, model="neubtf", steps=1, settings=given)


def test_heights_are_taught_turned_and_features_are_not(tiny: BTF) -> None:
    image = torch.rand(1, 2, 8, 12, generator=generator())
    seen = [neubtf.turned(image, turn) for turn in range(8)]
    assert {tuple(part.shape[2:]) for part in seen} == {(8, 12), (12, 8)}
    squares = [neubtf.turned(image[..., :8], turn) for turn in range(8)]
    assert all((a != b).any() for k, a in enumerate(squares) for b in squares[:k])
    torch.testing.assert_close(seen[2], image.flip((2, 3)))
    for share, heights_alone in (("0", False), ("0.999", True)):
        model = begun(tiny, turned=share, guessed="0")
        for progress in (0.0, 0.27, 0.5):
            model.step(progress)
        # Four texels of every channel; Adam does not move what has no gradient.
        moved = model.encoder.out.bias.detach().view(7, 4).abs().sum(1)
        assert moved[0] > 0
        assert (moved[1:] == 0).all() == heights_alone


# --- what is copied from the sample ---------------------------------------------------------------


def smooth(k: int, h: int, w: int) -> torch.Tensor:
    """(k, h, w) without a period."""
    coarse = torch.rand(1, k, h // 4, w // 4, generator=generator())
    return augment.resized(coarse, (h, w), wrap=True)[0]


def test_what_the_sample_shows_itself_is_copied_texel_by_texel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(copying, "_VOTERS", 1)
    answer, channels = smooth(3, 32, 48), torch.rand(3, 32, 48, generator=generator())
    copier = copying.Copier.of(answer, channels, wrap=True)
    assert copier is not None
    for shift in ((0, 0), (8, 16), (3, 5)):
        moved = encoders.in_parts(copier, answer.roll(shift, (1, 2))[None], wrap=True)[0]
        # One vote a texel, from where it was: float32 means of equal numbers.
        torch.testing.assert_close(moved[:-1], channels.roll(shift, (1, 2)), atol=1e-5, rtol=0)
        # Rounding of squares in float32
        assert moved[-1].max() < 1e-2


@pytest.mark.parametrize("wrap", [True, False])
def test_copied_in_parts_is_copied_whole(wrap: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    copier = copying.Copier.of(smooth(3, 32, 32), torch.rand(3, 32, 32), wrap=wrap)
    asked = smooth(3, 96, 80)[None]
    assert copier is not None
    whole = encoders.in_parts(copier, asked, wrap=wrap)
    monkeypatch.setattr(encoders, "_PART", 32)
    torch.testing.assert_close(encoders.in_parts(copier, asked, wrap=wrap), whole)


def test_nothing_is_copied_from_what_is_left_out_nor_over_a_border() -> None:
    answer, channels = smooth(2, 40, 40), torch.rand(2, 40, 40, generator=generator())
    kept = windows.inside(windows.Window(10, 10, 20, 20), (40, 40))
    channels[:, kept] = torch.nan
    copier = copying.Copier.of(answer, channels, wrap=True, left_out=kept)
    assert copier is not None
    assert copier(answer[None]).isfinite().all()
    within = copying.Copier.of(answer, channels, wrap=False)
    assert within is not None
    assert within.places.min() == 4
    assert within.places.max() == 35
    assert copying.Copier.of(answer[:, :6], channels[:, :6], wrap=False) is None


def test_copies_count_by_what_they_would_have_bettered_and_fade_where_nothing_is_near() -> None:
    drawn = generator()
    wanted = torch.rand(3, 24, 24, generator=drawn)
    wrong = wanted + torch.randn(3, 24, 24, generator=drawn)
    everywhere, far = torch.ones(24, 24, dtype=torch.bool), torch.full((1, 24, 24), 2.0)
    # The encoder is right in channel 0, the copy in channel 1, both are equally wrong in 2.
    other = wanted + torch.randn(3, 24, 24, generator=drawn)
    answer = torch.stack([wanted[0], wrong[1], wrong[2]])
    copied = torch.cat([torch.stack([other[0], wanted[1], other[2]]), far])
    mix = copying.Mix.measured(answer, copied, wanted, everywhere, torch.ones(3))
    # 576 texels and a pull of 10 of them
    np.testing.assert_allclose(mix.share, [0, 1, 0.5], atol=0.06)
    assert mix.near == 2
    last = copied[[1, 0, 2, 3]]
    heights = copying.Mix.measured(
        answer[[1, 0, 2]], last, wanted[[1, 0, 2]], everywhere, mix.scale
    )
    # Encoders answer smooth heights: of noisy ones less than half is copied.
    np.testing.assert_allclose(heights.share[:2], [copying._MOST_OF_HEIGHTS, 0], atol=0.06)
    found, share = mix(answer, copied)
    assert share == pytest.approx(0.5, abs=0.03)
    assert (found[1] - wanted[1]).abs().mean() < 0.02
    copied[-1] = 40
    found, share = mix(answer, copied)
    # (2 / 40) squared of the way
    assert (found - answer).abs().max() < 0.01 * (copied[:-1] - answer).abs().max()
    assert share < 0.005


def test_files_hold_what_is_copied_from_and_propagation_says_how_much(
    tiny: BTF, untied: Path, tmp_path: Path
) -> None:
    report = json.loads(untied.with_name("untied.neubtf.report.json").read_text())
    assert 0 < report["copied"] <= 1
    arrays = file.training_arrays(untied)
    again = carrier.Carrier.of(arrays).arrays()
    assert again.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array)
    picture = guidance_of(tiny)[0].permute(1, 2, 0).numpy() ** 2.2
    carried = propagation.propagate(picture, untied, wrap="wrap")
    assert 0 < carried.header.provenance["copied"] <= 1
    without = {name: a for name, a in arrays.items() if not name.startswith("copying.")}
    file.save(btfkit.load(untied), tmp_path / "encoder.safetensors", training=without)
    alone = propagation.propagate(picture, tmp_path / "encoder.safetensors", wrap="wrap")
    assert "copied" not in alone.header.provenance
    fit.fit(
        tiny, model="neubtf", steps=8, settings=TINY | {"copied": "false"},
        out=tmp_path / "none.safetensors",
    )  # fmt: skip
    assert not any(
        n.startswith("copying.") for n in file.training_arrays(tmp_path / "none.safetensors")
    )


# --- other guidance ------------------------------------------------------------------------------


def test_a_guidance_repeated_is_the_material_repeated_heights_and_all(
    tiny: BTF, fitted: Path
) -> None:
    picture = guidance_of(tiny)[0].permute(1, 2, 0).numpy() ** 2.2
    one = propagation.propagate(picture, fitted, wrap="wrap")
    four = propagation.propagate(np.tile(picture, (2, 2, 1)), fitted, wrap="wrap")
    heights = [m.weights["texture.heights"].astype(np.float32) for m in (one, four)]
    assert np.ptp(heights[0]) > 0
    # float16, in tile widths
    np.testing.assert_allclose(heights[1][:32, :32], heights[0] / 2, atol=1e-3)
    rng = np.random.default_rng(0)
    uv, light, view = rng.random((200, 2)), [0.3, 0.2, 0.9], [-0.5, 0.3, 0.8]
    answers = [m.evaluate(at, light, view).reflectance for m, at in ((one, uv), (four, uv / 2))]
    # heights and features in float16, magnified where a ray grazes
    assert np.abs(answers[0] - answers[1]).mean() < 2e-3


def test_guidance_of_any_size_and_scale_is_carried(fitted: Path) -> None:
    rng = np.random.default_rng(0)
    for size in ((1, 1), (7, 40), (33, 17)):
        for wrap in ("wrap", "clamp"):
            picture = rng.random((*size, 3)).astype(np.float32)
            carried = propagation.propagate(picture, fitted, wrap=wrap)  # type: ignore[arg-type]
            assert carried.header.grid == size
            answer = carried.evaluate(rng.random((20, 2)), [0, 0.3, 0.9], [0.2, 0, 0.9])
            assert np.isfinite(answer.reflectance).all()
    half = propagation.propagate(rng.random((40, 64, 3)).astype(np.float32), fitted, scale=0.5)
    assert half.header.grid == (20, 32)


GUIDES: dict[str, np.ndarray] = {
    "constant": np.full((24, 24, 3), 0.3, np.float32),
    "black": np.zeros((24, 24, 3), np.float32),
    "one texel": np.full((1, 1, 3), 0.3, np.float32),
    "one row": np.linspace(0, 1, 600, dtype=np.float32).reshape(1, 200, 3),
    "hdr": np.random.default_rng(0).random((24, 24, 3)).astype(np.float32) * 1e4,
    "one bright texel": np.eye(24, dtype=np.float32)[..., None].repeat(3, 2)[:1] * 1e6,
    "below zero": np.random.default_rng(0).random((24, 24, 3)).astype(np.float32) - 0.5,
    "grey": np.random.default_rng(0).random((24, 24, 1)).astype(np.float32),
}


@pytest.mark.parametrize("kind", GUIDES)
@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
def test_group_23_a_guidance_that_shows_nothing_or_too_much_is_carried_and_copied_finite(
    kind: str, wrap: Any, untied: Path
) -> None:
    carried = propagation.propagate(GUIDES[kind], untied, wrap=wrap)
    assert carried.header.grid == GUIDES[kind].shape[:2]
    for array in carried.weights.values():
        assert np.isfinite(array.astype(np.float32)).all()
    at = np.random.default_rng(0).random((50, 2))
    answer = carried.evaluate(at, [0, 0.3, 0.9], [0.2, 0, 0.9]).reflectance
    assert np.isfinite(answer).all()
    # Nothing of it lies far from what the sample answers: features come from it, or from a decoder
    # and an encoder in the range they were taught.
    assert answer.max() < 20


def test_group_23_transparent_guidance_is_said_and_what_is_no_picture_is_refused(
    untied: Path,
) -> None:
    clear = np.random.default_rng(0).random((16, 16, 4)).astype(np.float32)
    clear[:4, :, 3] = 0
    with pytest.warns(UserWarning, match="no opacity: 64 texels that are clear throughout"):
        carried = propagation.propagate(clear, untied)
    assert carried.header.grid == (16, 16)
    for picture, message in (
        (np.zeros((8, 8, 5), np.float32), "guidance has 5 channels; expected 1"),
        (np.zeros((0, 8, 3), np.float32), "expected"),
        (np.zeros((8, 8), np.float32), r"shape \(8, 8\); expected \(h, w, c\)"),
        (np.broadcast_to(np.float32(0), (8000, 8000, 3)), "guidance of 8000 x 8000; at most"),
    ):
        with pytest.raises(ValueError, match=message):
            propagation.propagate(picture, untied)


def test_group_24_one_view_and_few_texels_are_fitted_and_carried(tiny: BTF, tmp_path: Path) -> None:
    view = np.flatnonzero((tiny.view == tiny.view[0]).all(axis=1))
    few = tiny.subset(view).crop(slice(0, 3), slice(0, 5))
    report = fit.fit(few, model="neubtf", steps=12, settings=TINY, out=tmp_path / "m.safetensors")
    assert all(math.isfinite(value) for value in report.errors.values() if isinstance(value, float))
    with pytest.warns(UserWarning, match="ended early"):
        carried = propagation.propagate(GUIDES["grey"], tmp_path / "m.safetensors")
    assert "copied" not in carried.header.provenance


def test_a_tile_keeps_its_heights_in_texels(fitted: Path) -> None:
    rng = np.random.default_rng(0)
    coarse = torch.from_numpy(rng.random((1, 3, 20, 26)).astype(np.float32))
    picture = augment.resized(coarse, (60, 78), wrap=False)[0].permute(1, 2, 0).numpy()
    carried = propagation.propagate(picture, fitted)
    tile, tiling = tile_neubtf(carried)
    assert tile.header.grid == tiling.index.size != carried.header.grid
    texels = [
        m.weights["texture.heights"].astype(np.float32) * m.header.grid[1] for m in (carried, tile)
    ]
    # float16
    np.testing.assert_allclose(tiling.index.of(texels[0]), texels[1], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("size", [(32, 32), (31, 45), (1, 6)])
def test_coarser_levels_are_means_of_the_finest_features(
    size: tuple[int, int], fitted: Path
) -> None:
    picture = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    weights = propagation.propagate(picture, fitted).weights
    mean = weights["texture.0.0"].astype(np.float32).mean(axis=(0, 1))
    last = max(size).bit_length() - 1
    assert weights[f"texture.0.{last}"].shape == (1, 1, 8)
    for level in range(1, last + 1):
        # float16, of order one
        found = weights[f"texture.0.{level}"].astype(np.float32).mean(axis=(0, 1))
        np.testing.assert_allclose(found, mean, atol=3e-3)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_blurred_query_is_answered_nearer_to_the_blurred_truth_than_a_sharp_one(
    level: int, tiny: BTF, sharp: NeuBTF
) -> None:
    material, footprint = sharp, 0.5 * 2.0**level
    blur = gaussian(32, footprint**2 - 0.25, wrap=True)
    errors = np.zeros(2)
    for pair in range(0, len(tiny), 8):
        truth = np.einsum("ij,jkc,lk->ilc", blur, tiny.texture(pair), blur)
        for k, asked in enumerate((footprint, 0.5)):
            at = texel_centres(32, 32)
            answer = material.evaluate(at, tiny.light[pair], tiny.view[pair], asked).reflectance
            errors[k] += np.square(answer - truth).mean()
    assert errors[0] < 0.7 * errors[1]


# --- files of before -----------------------------------------------------------------------------


def test_a_file_of_the_published_model_under_its_old_name_is_read_as_what_it_is(
    tiny: BTF, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "old.neubtf.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(NeuBTFPaper, "model", "neubtf")
        patch.setattr(published, "_LEAST_TAUGHT", 1)
        settings = {"texels": "64", "pairs": "4"}
        fit.fit(tiny, model="neubtf-paper", steps=20, out=path, settings=settings)
    assert b'"model":"neubtf"' in path.read_bytes()
    assert btfkit.load(path).model == file.header_of(path)["model"] == "neubtf-paper"
    assert propagation.has_encoder(path)
    picture = np.random.default_rng(0).random((16, 24, 3)).astype(np.float32)
    assert propagation.propagate(picture, path).model == "neubtf-paper"


def test_a_propagated_model_cannot_be_propagated_and_a_foreign_encoder_is_refused(
    fitted: Path, tmp_path: Path
) -> None:
    picture = np.random.default_rng(0).random((16, 24, 3)).astype(np.float32)
    propagation.propagate(picture, fitted, out=tmp_path / "p.safetensors")
    assert btfkit.load(tmp_path / "p.safetensors").model == "neubtf"
    assert not propagation.has_encoder(tmp_path / "p.safetensors")
    with pytest.raises(FitError, match="has no encoder"):
        propagation.propagate(picture, tmp_path / "p.safetensors")
    arrays = file.training_arrays(fitted)
    del arrays["encoder.out.bias"]
    file.save(btfkit.load(fitted), tmp_path / "bad.safetensors", training=arrays)
    with pytest.raises(FormatError, match="the encoder does not fit this version"):
        propagation.propagate(picture, tmp_path / "bad.safetensors")
