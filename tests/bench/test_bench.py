"""The benchmark: what it measures, keeps and takes up again."""

from __future__ import annotations

import csv
import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from btfkit.bench import cases, cells, kernels, run
from btfkit.bench.cases import asked, procedural, rows_of, stored
from btfkit.btf import BTF
from btfkit.cli import btfkit
from btfkit.cli.outcome import run as run_cli
from btfkit.errors import BtfkitError
from btfkit.fitting import MODELS
from btfkit.fitting.fit import fit
from btfkit.heldout import split
from btfkit.io import open as open_btf
from btfkit.io import queryfile
from btfkit.io.store import writer
from btfkit.materials import file
from btfkit.native import neural as native

_AT = Path(__file__).parents[2] / "benchmarks" / "targets.py"
_SPEC = importlib.util.spec_from_file_location("targets", _AT)
targets = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(targets)

compiled = pytest.mark.skipif(not native.available(), reason="the kernel was not built")
TINY = run.Profile(
    materials=("print",), models=("lambert", "neumip"), budgets_cpu_s=(0.05, 0.1), size=16,
    directions=3, kernel_seconds=0,
)  # fmt: skip
CONTRACT = ("mse", "psnr", "mse_log1p", "psnr_log1p", "mae", "psnr_srgb", "ssim_srgb", "flip")


def test_cases_hold_out_pictures_and_every_level():
    case = procedural("print", size=16, directions=3, seed=0)
    assert len(case.train) == 9
    assert len(case.pictures) == 12
    levels = np.unique(np.log2(2 * case.queries.footprint))
    np.testing.assert_array_equal(levels, np.arange(5))
    trained = {tuple(row) for row in np.hstack([case.train.light, case.train.view])}
    held = np.hstack([case.pictures.light, case.pictures.view])
    assert not trained & {tuple(row) for row in held}
    # The coarsest level is next to the mean of each picture.
    coarse = case.queries.footprint == 8
    for pair in range(12):
        same = coarse & (case.queries.light == case.pictures.light[pair]).all(axis=1)
        mean = case.pictures.texture(pair).mean(axis=(0, 1))
        np.testing.assert_allclose(case.queries.rgb[same].mean(axis=0), mean, rtol=0.1, atol=0.01)


def test_stores_hold_out_what_fit_holds_out(tmp_path):
    case = procedural("print", size=16, directions=5, seed=0)
    writer.write(case.train, tmp_path / "p.btf.zarr")
    found = stored(tmp_path / "p.btf.zarr", holdout=0.2, seed=3)
    assert found.name == "p"
    assert (len(found.train), len(found.pictures)) == (20, 5)


@pytest.mark.slow
def test_a_run_reports_the_contracts_errors_and_is_taken_up_again(tmp_path, monkeypatch):
    found = run.run(TINY, tmp_path / "out")
    labels = [(row["label"], row["budget_cpu_s"]) for row in found["cells"]]
    assert labels[:3] == [("lambert", None), ("neumip", 0.05), ("neumip", 0.1)]
    assert ("neumip offset=0", 0.1) in labels
    for row in found["cells"]:
        assert all(np.isfinite(row[key]) for key in CONTRACT)
        assert row["bytes"] > 0
        assert row["queries_per_s"] > 0
    ours = found["cells"][2]
    assert 0.1 <= ours["cpu_seconds"] < 5
    assert 1000 < ours["parameters"] < 4000
    assert [level["level"] for level in ours["levels"]] == [0, 1, 2, 3, 4]
    for level in ours["levels"]:
        assert all(np.isfinite(level[key]) for key in CONTRACT)
    assert ours["levels"][0]["flip"] == ours["flip"]
    assert ours["machine"] == {key: found["machine"][key] for key in ours["machine"]}
    assert ours["curve"][-1]["cpu_s"] == pytest.approx(ours["cpu_seconds"])
    for name in (
        "bench.json",
        "bench.md",
        "bench.csv",
        "bench.tex",
        "rate-distortion.png",
        "time-to-error.png",
    ):
        assert (tmp_path / "out" / name).stat().st_size > 500
    assert json.loads((tmp_path / "out" / "bench.json").read_text())["cells"] == found["cells"]

    def refuse(*_):
        raise AssertionError("a finished cell was run again")

    monkeypatch.setattr(run, "run_cell", refuse)
    seen = []
    again = run.run(TINY, tmp_path / "out", progress=lambda done, of: seen.append(done / of))
    assert again["cells"] == found["cells"]
    assert seen[-1] == 1
    with pytest.raises(BtfkitError, match="name another folder"):
        run.run(replace(TINY, size=24), tmp_path / "out")


def test_a_model_that_refuses_a_material_is_reported_not_raised(tmp_path, monkeypatch):
    def refuse(cell, case):
        raise BtfkitError(f"{cell.model} wants more than {len(case.train)} pairs")

    monkeypatch.setattr(run, "run_cell", refuse)
    found = run.run(replace(TINY, models=("lambert",)), tmp_path / "out")
    assert found["cells"][0]["failed"] == "lambert wants more than 9 pairs"
    assert "wants more than 9 pairs" in (tmp_path / "out" / "bench.md").read_text()


def test_unknown_names_are_refused_with_what_there_is(tmp_path):
    with pytest.raises(ValueError, match="no model 'bfdr'; there are lambert"):
        run.run(replace(TINY, models=("bfdr",)), tmp_path)
    with pytest.raises(ValueError, match="no material 'jelly'; there are cobbles"):
        run.run(replace(TINY, materials=("jelly",)), tmp_path)


def test_the_verb_prints_one_json_object(tmp_path, capsys):
    arguments = ["bench", "print", "--model", "lambert", "--size", "16", "--directions", "2"]
    (tmp_path / "b").mkdir()
    # The tables of kernels have a test of their own, and take their time.
    (tmp_path / "b" / "kernels.json").write_text('{"skips": [{"skip": "none", "ns": 1.0}]}')
    code = run_cli(btfkit, [*arguments, "-o", str(tmp_path / "b"), "--quick", "--json"])
    assert code == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["cells"][0]["model"] == "lambert"
    assert found["machine"]["threads"] >= 1
    assert found["skips"] == [{"skip": "none", "ns": 1.0}]
    assert "## What each skip saves" in (tmp_path / "b" / "bench.md").read_text()
    assert len(found["files"]) == 6
    assert run_cli(btfkit, ["bench", "jelly", "-o", str(tmp_path / "c")]) == 1
    assert "neither a file nor a material" in capsys.readouterr().err


@pytest.mark.slow
def test_cells_of_several_calls_are_told_together(tmp_path):
    first = replace(TINY, models=("lambert",))
    run.run(first, tmp_path)
    found = run.run(
        replace(TINY, models=("neumip",), budgets_cpu_s=(0.05,), materials=("print",)), tmp_path
    )
    assert {row["model"] for row in found["cells"]} == {"lambert", "neumip"}
    assert found["cells"][0]["model"] == "lambert"
    table = (tmp_path / "bench.md").read_text()
    assert "| lambert |" in table
    assert "| neumip size=8 |" in table
    other = run.run(replace(first, materials=("cobbles",)), tmp_path)
    assert [row["material"] for row in other["cells"]][:1] == ["cobbles"]
    assert {row["material"] for row in other["cells"]} == {"cobbles", "print"}


@pytest.mark.slow
def test_cells_of_other_machines_and_of_older_versions_are_told(tmp_path):
    found = run.run(replace(TINY, models=("lambert",), materials=("print", "cobbles")), tmp_path)
    assert "Measured elsewhere" not in (tmp_path / "bench.md").read_text()
    print_, cobbles = (tmp_path / "cells" / f"{n}_lambert_0.json" for n in ("print", "cobbles"))
    old = json.loads(print_.read_text())
    for key in ("machine", "ssim_srgb"):
        del old[key]
    print_.write_text(json.dumps(old))
    far = json.loads(cobbles.read_text())
    far["machine"]["processor"] = "Z80"
    far["psnr"] = "inf"
    cobbles.write_text(json.dumps(far))
    again = run.run(replace(TINY, models=("lambert",)), tmp_path)
    assert len(again["cells"]) == len(found["cells"]) == 2
    table = (tmp_path / "bench.md").read_text()
    assert "1 of 2 cells on an unnamed machine" in table
    assert f"1 of 2 cells on Z80, {far['machine']['cores']} cores" in table
    assert "| inf |" in table


@pytest.mark.slow
def test_processes_may_run_into_one_folder_at_a_time(tmp_path):
    """Two materials at once: no cell is lost, and who ends last tells of all."""
    command = [
        sys.executable, "-c", "from btfkit.cli import main; main()", "bench", "--model", "lambert", "--model", "pca",
        "--size", "16", "--directions", "3", "-o", str(tmp_path / "b"), "--quick", "--quiet",
    ]  # fmt: skip
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "kernels.json").write_text('{"skips": []}')
    both = [subprocess.Popen([*command, name]) for name in ("print", "cobbles")]
    assert [process.wait() for process in both] == [0, 0]
    assert not list(tmp_path.glob("b/**/.*"))
    found = run.cells_in(tmp_path / "b", TINY)
    assert [(row["material"], row["label"]) for row in found] == [
        (material, label)
        for material in ("print", "cobbles")
        for label in ("lambert", *(f"pca rank={rank}" for rank in (1, 2, 4, 8, 16, 32)))
    ]
    written = json.loads((tmp_path / "b" / "bench.json").read_text())["cells"]
    assert len(written) == 14


@pytest.mark.slow
def test_one_rainer20_is_trained_on_all_materials_and_answers_for_each(tmp_path):
    profile = replace(
        TINY, models=("rainer20",), materials=("print", "cobbles"), budgets_cpu_s=(0.05, 0.1)
    )
    found = run.run(profile, tmp_path)["cells"]
    shared = [row for row in found if "shared" in row["settings"]]
    assert [row["material"] for row in shared] == ["print", "cobbles"]
    assert {row["label"] for row in shared} == {"rainer20 shared=print+cobbles"}
    # One training: the same steps, the budget of both together, only the codes are apart.
    assert shared[0]["cpu_seconds"] == shared[1]["cpu_seconds"] >= 0.2
    assert shared[0]["steps"] == shared[1]["steps"]
    assert shared[0]["mse"] != shared[1]["mse"]
    assert len(found) == 6


@pytest.mark.slow
def test_shared_networks_fit_the_material_they_are_asked_for():
    """Trained on two materials at once, the answer for each is nearer to it than to the other."""
    from btfkit.materials.evaluation import errors_on_btf

    bright, dark = (procedural(name, size=8, directions=4, seed=0) for name in ("print", "cobbles"))
    trainable, _ = cells._trainable(cells.Cell("print", "rainer20"), [bright, dark])
    for step in range(150):
        trainable.step(step / 150)
    for which, (own, other) in enumerate(((bright, dark), (dark, bright))):
        material = trainable.material(which)
        mse = [errors_on_btf(material, case.train)["mse_log1p"] for case in (own, other)]
        assert mse[0] < 0.5 * mse[1]


@pytest.mark.slow
def test_query_files_are_benchmarked_by_what_can_be_fitted_to_them(tmp_path):
    case = procedural("print", size=16, directions=3, seed=0)
    queryfile.write(case.queries, tmp_path / "q.npz")
    held = asked(tmp_path / "q.npz", holdout=0.1, seed=0)
    assert len(held.train) + len(held.queries) == len(case.queries)
    assert len(held.queries) == round(0.1 * len(case.queries))
    profile = replace(
        TINY, materials=(), stores=(tmp_path / "q.npz",), models=tuple(MODELS),
        budgets_cpu_s=(0.05,), holdout=0.1,
    )  # fmt: skip
    found = run.run(profile, tmp_path / "out")["cells"]
    good = {row["model"] for row in found if "failed" not in row}
    assert {"lambert", "neumip", "neumip-paper"} <= good
    assert all("QuerySet" not in row["failed"] for row in found if "failed" in row)
    for row in found:
        assert row["material"] == "q.npz"
        assert row["case"]["rows"] == len(held.train)
        if "failed" not in row:
            assert row["rows"] == len(held.queries)
            assert [level["level"] for level in row["levels"]] == [0, 1, 2, 3, 4]
        else:
            assert row["failed"].startswith(f"{row['model']} ")
    assert "needs the images of a BTF" in (tmp_path / "out" / "bench.md").read_text()


def test_query_files_without_answers_or_without_usable_rows_are_refused(tmp_path):
    case = procedural("print", size=16, directions=3, seed=0)
    queryfile.write(replace(case.queries, rgb=None), tmp_path / "mute.npz")
    with pytest.raises(ValueError, match=r"mute.npz has no answers \(rgb\)"):
        asked(tmp_path / "mute.npz", holdout=0.1, seed=0)
    below = replace(case.queries, view=case.queries.view * [1, 1, -1])
    queryfile.write(below, tmp_path / "below.npz")
    with pytest.raises(ValueError, match=r"held-out rows of .*below\.npz can be compared with"):
        asked(tmp_path / "below.npz", holdout=0.1, seed=0)


def test_materials_of_one_name_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two materials are called 'print'"):
        run.run(replace(TINY, stores=(tmp_path / "print.btf.zarr",)), tmp_path)


@pytest.mark.parametrize(("shape", "wrap"), [((16, 16), "wrap"), ((12, 20), "clamp")])
def test_small_pictures_hold_what_queries_find_at_their_places(shape, wrap):
    rng = np.random.default_rng(0)
    images = rng.random((1, *shape, 3)).astype(np.float32)
    up = np.array([[0.0, 0.0, 1.0]])
    queries, coarse = cases._levels(BTF(images, up, up, wrap=wrap))
    assert [small.level for small in coarse] == list(range(1, max(shape).bit_length()))
    for small in coarse:
        at = np.full((*shape, 3), np.nan, np.float32)
        row, col = (np.floor(small.uv[..., k] * shape[1 - k]).astype(int) for k in (1, 0))
        at[row, col] = small.images[0]
        counts = small.images.shape[1:3]
        for side, stride in zip(counts, np.array(shape) / 2**small.level, strict=True):
            assert max(np.floor(stride), 1) <= side <= np.floor(stride) + 1
        same = queries.footprint == small.footprint
        row, col = (np.floor(queries.uv[same, k] * shape[1 - k]).astype(int) for k in (1, 0))
        both = np.isfinite(at[row, col]).all(axis=1)
        # The coarsest picture is one texel, which half of the queries may miss.
        assert both.any() or side == 1
        # The same float32 sums, cut out in two ways.
        np.testing.assert_array_equal(at[row, col][both], queries.rgb[same][both])


def test_cells_are_told_apart_by_their_keys():
    models = ("pca", "neumip", "neumip-paper")
    found = cells.cells_of("a", models, (1.0, 2.0), seed=0, rows=64)
    assert len({cell.key for cell in found}) == len(found)
    assert sum(cell.budget_cpu_s is None for cell in found) == 6
    # Every budget of the plain models; of the variants only the longest.
    assert sum(cell.budget_cpu_s == 1.0 for cell in found) == 2


def test_variants_go_by_the_data(tmp_path):
    case = procedural("print", size=16, directions=3, seed=0)
    writer.write(case.train, tmp_path / "p.btf.zarr")
    queryfile.write(case.queries, tmp_path / "q.npz")
    queryfile.write(replace(case.queries, size=None, footprint=None), tmp_path / "free.npz")
    assert [rows_of(tmp_path / name) for name in ("p.btf.zarr", "q.npz", "free.npz")] == [
        16, 16, None,
    ]  # fmt: skip
    found = cells.cells_of("a", ("neumip", "pca"), (1.0,), seed=0, rows=None, pictured=False)
    assert [cell.label for cell in found] == [
        "neumip", "neumip offset=0", "neumip precision=int8", "pca",
    ]  # fmt: skip


def row(model, budget, mse, levels=(), material="m", **settings):
    return {
        "material": material, "model": model, "label": model, "settings": settings,
        "budget_cpu_s": budget, "mse": 2 * mse, "mse_log1p": mse,
        "psnr_log1p": -10 * np.log10(mse),
        "levels": [{"level": n, "mse": value} for n, value in enumerate(levels)],
    }  # fmt: skip


def test_targets_compare_finished_runs_of_equal_budgets():
    rows = [
        row("neumip", 5, 4e-3), row("neumip", 15, 2e-3), row("neumip", 60, 1e-3),
        row("neumip", 60, 3e-3, offset="0"), row("neumip-paper", 60, 3e-3),
        row("neumip-paper", 600, 2e-3),
    ]  # fmt: skip
    passing, equal, offsets = targets.targets(rows)
    assert passing["what"] == "neumip passes neumip-paper's 26.99 dB after 600 CPU s"
    assert passing["measured"] == "within 15 CPU s: 26.99 dB"
    assert equal["what"] == "neumip over neumip-paper, both after 60 CPU s"
    assert equal["measured"] == "+4.77 dB"
    assert offsets["measured"] == "3.00 x (log1p), 3.00 x (linear)"


def test_targets_say_what_falls_short_and_compare_nothing_of_unequal_budgets():
    rows = [row("neumip", 5, 4e-3), row("neumip", 15, 3e-3), row("neumip-paper", 60, 2e-3)]
    (passing,) = targets.targets(rows)
    assert passing["measured"] == "not passed: 25.23 dB after 15 CPU s"
    assert targets.targets([row("neumip", 5, 4e-3), row("neumip", 9, 1e-3, offset="0")]) == []
    assert targets.targets([{**row("neumip", 5, 1e-3), "failed": "no"}]) == []


def test_targets_say_at_which_levels_the_error_rises():
    (falling,) = targets.targets([row("neumip", 5, 4e-3, levels=(8.0, 4.0, 6.0, 2.0))])
    assert falling["measured"] == "at 2 of 3 levels, 4.0 x over all; rises at 2 (1.50 x)"
    (falling,) = targets.targets([row("neumip", 5, 4e-3, levels=(8.0, 4.0))])
    assert falling["measured"] == "at 1 of 1 levels, 2.0 x over all"


@compiled
@pytest.mark.slow
def test_kernel_tables_stay_below_the_measured_peak():
    table = kernels.kernel_table(0.05)
    for row in table:
        # The peak is the best of many windows, the rate of a few: noise may lift it by a tenth.
        assert 0.01 < row["train_share"] < 1.1
        assert 0.01 < row["evaluate_share"] < 1.1
    skips = {row["skip"]: row["of_everything"] for row in kernels.skip_table(0.1, size=64)}
    assert skips["no offset stage"] < 0.9
    assert skips["16 lights a view, view stage kept"] < 0.8
    assert all(0 < row["share"] < 1.5 for row in kernels.loop_table(0.05))
    assert next(row["read"] for row in kernels.region_table(0.05)) == "whole textures"


@compiled
def test_smaller_textures_change_little():
    from btfkit.fitting.fit import fit

    case = procedural("print", size=16, directions=4, seed=0)
    fitted = fit(case.train, model="neumip", steps=50, settings={"batch": "512"}, holdout=0)
    rows = slice(0, 2000)
    ask = (case.queries.uv[rows], case.queries.light[rows], case.queries.view[rows], None)
    table = kernels.precision_table(fitted.material, ask)
    assert [row["precision"] for row in table] == ["float32", "float16", "int8"]
    assert table[0]["mae"] == 0
    assert table[0]["bytes"] > table[1]["bytes"] > table[2]["bytes"]
    assert table[1]["mae"] < 1e-3
    assert table[2]["mae"] < 1e-2


@pytest.mark.slow
def test_answers_from_elsewhere_are_scored_as_a_models_own(tmp_path, capsys):
    """What lambert answers to the questions gets the errors of lambert's own cell."""
    store = tmp_path / "cloth.btf.zarr"
    writer.write(procedural("print", size=16, directions=5, seed=0).train, store)
    common = ["bench", str(store), "-o", str(tmp_path / "out"), "--json"]
    assert run_cli(btfkit, [*common, "--questions"]) == 0
    (questions,) = json.loads(capsys.readouterr().out.splitlines()[-1])["questions"]
    assert queryfile.read(Path(questions)).rgb is None

    train = training_part(store)
    material = fit(train, model="lambert", holdout=0).material
    model, answers = tmp_path / "l.safetensors", tmp_path / "answers.npz"
    file.save(material, model)
    assert run_cli(btfkit, ["query", str(model), questions, "-o", str(answers)]) == 0

    (tmp_path / "out" / "kernels.json").write_text("{}")
    assert run_cli(btfkit, [*common, "--model", "lambert"]) == 0
    assert run_cli(btfkit, [*common, "--answers", f"some & ours={answers}"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["cells"]
    own, elsewhere = sorted(found, key=lambda row: row["model"] != "lambert")
    assert elsewhere["model"] == "some & ours"
    for key in CONTRACT:
        # The questions are float32, the cell's own texel centres float64.
        assert elsewhere[key] == pytest.approx(own[key], rel=1e-4)
    with (tmp_path / "out" / "bench.csv").open() as table:
        lines = list(csv.DictReader(table))
    assert [line["label"] for line in lines] == [row["label"] for row in found]
    assert float(lines[0]["psnr"]) == found[0]["psnr"]
    printed = (tmp_path / "out" / "bench.tex").read_text()
    assert r"some \& ours & " in printed
    assert printed.count(r"\begin{tabular}") == printed.count(r"\end{tabular}") == 1
    assert "## Targets" not in (tmp_path / "out" / "bench.md").read_text()


def test_answers_to_other_questions_are_refused(tmp_path, capsys):
    store = tmp_path / "cloth.btf.zarr"
    writer.write(procedural("print", size=16, directions=3, seed=0).train, store)
    common = ["bench", str(store), "-o", str(tmp_path / "out")]
    assert run_cli(btfkit, [*common, "--questions"]) == 0
    asked = queryfile.read(Path(capsys.readouterr().out.strip()))
    wrong = replace(asked, rgb=np.zeros((len(asked), 3)), uv=asked.uv[::-1])
    queryfile.write(wrong, tmp_path / "a.npz")
    assert run_cli(btfkit, [*common, "--answers", f"ours={tmp_path / 'a.npz'}"]) == 1
    assert "not the questions of cloth, in their order" in capsys.readouterr().err
    queryfile.write(asked, tmp_path / "b.npz")
    assert run_cli(btfkit, [*common, "--answers", f"ours={tmp_path / 'b.npz'}"]) == 1
    assert "has no answers (rgb)" in capsys.readouterr().err


def training_part(store):
    """The pairs of a store that its models are trained on."""
    btf = open_btf(store)
    return btf.subset(split(len(btf))[0])


@pytest.mark.slow
def test_stages_of_a_calibration_are_measured_by_themselves_and_kept(tmp_path, capsys):
    names = ["merge", "bundle", "rectify", "heightfield"]
    line = ["bench", *names, "--quick", "-o", str(tmp_path / "out"), "--json"]
    assert run_cli(btfkit, line) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["cells"] == []
    stages = found["stages"]
    assert [len({row[size] for row in stages[name]}) for name, size in
            (("merge", "megapixels"), ("bundle", "views"), ("rectify", "texels"),
             ("heightfield", "texels"))] == [3, 3, 3, 3]  # fmt: skip
    largest = {row["method"]: row for row in stages["merge"] if row["megapixels"] > 0.06}
    ours, bound = largest["noise model, iterated"], largest["bound"]
    # Thirteen thousand pixels a decade tell a deviation to a half per cent.
    assert (
        bound["sd 20"] * 0.97
        < ours["sd 20"]
        < 1.05 * bound["sd 20"]
        < largest["hat weights"]["sd 20"]
    )
    held = [row["held out, px"] for row in stages["bundle"]]
    assert max(held) < 0.02
    assert (
        stages["bundle"][-1]["focal length, relative"]
        < 4 * stages["bundle"][-1]["its sd, relative"]
    )
    straight = {row["method"]: row for row in stages["rectify"]
                if row["texels"] == 16 and row["tilt, degrees"] == 0}  # fmt: skip
    assert straight["ewa"]["dB to Gaussians"] > straight["bilinear"]["dB to Gaussians"] + 10
    assert straight["area"]["dB to areas"] > straight["bilinear"]["dB to areas"] + 5
    largest = {row["source"]: row for row in stages["heightfield"] if row["texels"] == 24}
    # 100 steps of a model leave a third of a texel; light sees what it does not
    assert largest["all three"]["filtered, half"] < 0.6 * largest["a model's"]["filtered, half"]
    assert largest["all three"]["cpu_s"] > largest["a model's"]["cpu_s"]
    page = (tmp_path / "out" / "bench.md").read_text()
    assert "## Merging" in page
    assert "## Heights of traced cobbles" in page
    assert "| hat weights |" in page
    # What is there is not measured again, and other sizes do not mix with it.
    kept = (tmp_path / "out" / "stages" / "merge.json").stat().st_mtime_ns
    assert run_cli(btfkit, line) == 0
    assert (tmp_path / "out" / "stages" / "merge.json").stat().st_mtime_ns == kept
    line = [*line[:5], "--size", "48", "--directions", "12", *line[6:]]
    assert run_cli(btfkit, line) == 1
    assert "was measured with" in capsys.readouterr().err
