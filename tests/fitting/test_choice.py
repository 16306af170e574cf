"""`auto`: what it takes for data of every kind, and that it says why."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from btfkit import directions
from btfkit.btf import BTF
from btfkit.fitting.choice import choose, moving
from btfkit.fitting.fit import fit
from btfkit.queries import QuerySet
from btfkit.relief.synth import direction_set, synth_btf


@cache
def traced(name: str, relief_texels: float | None = None) -> BTF:
    lazy = synth_btf(
        name, size=32, lights="7", views="19", samples=8, relief_texels=relief_texels
    )  # fmt: skip
    return replace(lazy, textures=lazy.textures.batch(range(len(lazy))))


def queries(**changes: object) -> QuerySet:
    rng = np.random.default_rng(0)
    view = directions.normalize(rng.normal(size=(64, 3)) + [0, 0, 3])
    base = QuerySet(rng.random((64, 2)), view, view, rgb=np.ones((64, 3)), size=(8, 8))
    return replace(base, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pairs", "size", "model", "reason"),
    [
        (slice(0, 3), 32, "lambert", "3 pairs say little about gloss"),
        (slice(0, 20), 32, "interpolation", "20 pairs are too few to learn from"),
        (slice(None), 1, "interpolation", "one texel is a BRDF table"),
        (slice(None), 32, "neumip", "7 lights and 19 views of 32 x 32 texels"),
    ],
)
def test_the_size_of_the_data_decides(pairs: slice, size: int, model: str, reason: str) -> None:
    btf = traced("cobbles").subset(np.arange(133)[pairs])
    choice = choose(btf.crop(slice(0, size), slice(0, size)))
    assert choice.model == model
    assert choice.reasons[0].startswith(f"{model}: ")
    assert reason in choice.reasons[0]


def test_under_one_view_nothing_moves() -> None:
    light = direction_set("40")
    view = np.tile([[0.0, 0.0, 1.0]], (40, 1))
    choice = choose(BTF(np.ones((40, 4, 4, 3), np.float32), light, view))
    assert choice.model == "neumip"
    assert choice.settings == {"levels": "1", "offset": "0"}
    assert any("no offset stage: there is one view, nothing moves" in why for why in choice.reasons)


def test_a_flat_material_gets_no_offset_stage_and_a_deep_one_does() -> None:
    flat, deep = choose(traced("print")), choose(traced("cobbles"))
    assert flat.settings["offset"] == "0"
    assert any("no offset stage: the structure stays within" in why for why in flat.reasons)
    assert "offset" not in deep.settings
    assert any("offset stage: the structure moves by" in why for why in deep.reasons)
    assert flat.settings["levels"] == deep.settings["levels"] == "1"
    assert any("a BTF has no footprints" in why for why in flat.reasons)


def test_movement_grows_with_the_relief_and_is_told_apart_from_gloss() -> None:
    low, high = (moving(traced("brick", depth)) for depth in (0.01, 1.5))
    assert low is not None
    assert high is not None
    assert high > 5 * low
    scratched = moving(traced("scratched"))
    assert scratched is not None
    assert scratched < 0.02


def test_a_known_height_is_found_where_it_shifts_the_texture() -> None:
    """Blocks at two heights under an ideal parallel projection, and nothing else changes."""
    rng = np.random.default_rng(1)
    texture = np.zeros((32, 32))
    for k in range(1, 4):
        for _ in range(6):
            fu, fv = rng.integers(-k, k + 1, 2)
            v, u = np.mgrid[:32, :32] / 32
            texture += np.cos(2 * np.pi * (fu * u + fv * v + rng.random())) / k
    texture = np.exp(0.3 * texture)
    views = direction_set("19")
    light = np.tile([[0.0, 0.0, 1.0]], (19, 1))

    def seen(view: np.ndarray, height: float) -> np.ndarray:
        # it appears shifted by + height x tan: rows run against y
        du, dv = height * view[0] / view[2], -height * view[1] / view[2]
        freq = np.fft.fftfreq(32)
        phase = np.exp(-2j * np.pi * (freq[None] * du + freq[:, None] * dv))
        return np.fft.ifft2(np.fft.fft2(texture) * phase).real

    high = np.zeros((32, 32), bool)
    high[:, 16:] = True
    images = [np.where(high, seen(v, 0.3), seen(v, -0.3)) for v in views]
    btf = BTF(np.stack(images)[..., None].astype("f4"), light, views, channels=("Y",), wrap="wrap")
    # half the texels at +0.3 and half at -0.3: a deviation of 0.3, less what smoothing and the
    # linear expansion of shifts up to 0.8 texels lose
    assert moving(btf) == pytest.approx(0.3, rel=0.25)
    mirrored = replace(btf, textures=btf.textures.batch(range(19))[:, ::-1])
    still = replace(btf, textures=np.repeat(btf.texture(0)[None], 19, axis=0))
    assert moving(still) == pytest.approx(0, abs=1e-6)
    found = moving(mirrored)
    assert found is not None
    assert found < 0.25, "a mirrored axis must not look like a relief as clear"


def test_without_common_lights_nothing_is_said_to_be_flat() -> None:
    directions_ = direction_set("40")
    btf = BTF(np.ones((40, 8, 8, 1), np.float32), directions_, directions_, channels=("Y",))
    assert moving(btf) is None
    choice = choose(btf)
    assert "offset" not in choice.settings
    assert any("no two views share a light" in why for why in choice.reasons)


def test_missing_texels_and_black_images_do_not_disturb() -> None:
    btf = traced("cobbles")
    textures = btf.textures.batch(range(len(btf)))
    textures[:, 3:6, 7] = np.nan
    textures[5] = 0
    assert choose(replace(btf, textures=textures)).model == "neumip"
    assert choose(replace(btf, textures=np.zeros_like(textures))).settings["offset"] == "0"


def test_queries_get_the_levels_that_their_footprints_ask_for() -> None:
    assert choose(queries()).model == "neumip"
    assert choose(queries()).settings["levels"] == "1"
    assert choose(queries(footprint=np.full(64, 0.5))).settings["levels"] == "1"
    blurred = choose(queries(footprint=np.linspace(0.5, 8, 64)))
    assert "levels" not in blurred.settings
    frontal = choose(queries(view=np.tile([[0, 0, 1.0]], (64, 1))))
    assert frontal.settings["offset"] == "0"


def test_queries_with_curvature_ask_for_a_model_that_knows_it() -> None:
    bend = np.linspace(0, 1, 64)
    choice = choose(queries(curvature=bend, opacity=1 - bend))
    assert choice.model == "sbtf"
    assert choice.reasons == (
        "sbtf: the queries have curvature, under which rays may pass the material",
    )
    assert choose(queries(curvature=0 * bend)).model == "neumip"


def test_holes_on_the_plane_ask_for_a_model_that_knows_them() -> None:
    bend = np.linspace(0, 1, 64)
    for parts, count in (({}, 1), ({"curvature": bend}, 2)):
        choice = choose(queries(opacity=bend, **parts))
        assert choice.model == "sbtf"
        assert len(choice.reasons) == count
        assert choice.reasons[-1].startswith("sbtf: rays pass on the plane, through holes")


def test_fit_takes_what_was_chosen_and_the_user_has_the_last_word() -> None:
    btf = traced("print")
    report = fit(btf, steps=1)
    assert report.material.model == "neumip"
    assert report.settings == {"levels": "1", "offset": "0"}
    assert report.choice == choose(btf).reasons
    assert fit(btf, steps=1, settings={"levels": "2"}).settings["levels"] == "2"
    assert fit(btf, steps=1, model="neumip").choice == ()
