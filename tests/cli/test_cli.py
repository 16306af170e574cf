"""The command line: how every verb behaves, whatever it does."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import click
import numpy as np
import pytest
from click.shell_completion import BashComplete

from btfkit.btf import BTF
from btfkit.cli import VERBS, btfkit
from btfkit.cli.options import DurationType, SettingType, SliceType, WindowType
from btfkit.cli.outcome import run
from btfkit.io.store import places, writer
from btfkit.jsonvalues import plain

ENTRY = str(Path(sys.executable).with_name("btfkit"))


@pytest.fixture
def store(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    light = rng.normal(size=(6, 3)) + [0, 0, 4]
    btf = BTF(rng.random((6, 8, 8, 3), np.float32), light, np.tile([0, 0, 1.0], (6, 1)))
    return writer.write(btf, tmp_path / "small.btf.zarr")


def call(*arguments: object) -> int:
    return run(btfkit, [str(argument) for argument in arguments])


def test_help_answers_in_a_third_of_a_second() -> None:
    # The contract's figure, in CPU seconds and the least of five, because machines are shared.
    def spent() -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return children.ru_utime + children.ru_stime

    def once() -> float:
        before = spent()
        done = subprocess.run([ENTRY, "--help"], capture_output=True, check=True, text=True)
        assert all(verb in done.stdout for verb in VERBS)
        return spent() - before

    assert min(once() for _ in range(5)) < 0.3


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself_with_an_example(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(verb, "--help") == 0
    text = capsys.readouterr().out
    assert f"btfkit {verb}" in text.split("Example:")[1]
    for option in ("--json", "--quiet", "--debug"):
        assert option in text


def test_a_result_is_one_json_object_on_the_last_line(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("info", store, "--json") == 0
    data = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert data["shape"] == [6, 8, 8, 3]
    assert data["views"] == 1


def test_info_lists_what_a_store_is(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", store) == 0
    text = capsys.readouterr().out
    assert "linear BT.709" in text
    assert "6, 8, 8, 3" in text


def test_a_missing_source_is_one_line_and_exit_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("ingest", "nowhere") == 1
    caught = capsys.readouterr()
    assert caught.err == "btfkit: error: nowhere: no such file or folder\n"
    assert caught.out == ""


def test_a_failure_is_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("ingest", "nowhere", "--json") == 1
    data = json.loads(capsys.readouterr().out)
    assert data["error"] == {
        "type": "FileNotFoundError",
        "message": "nowhere: no such file or folder",
    }


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["ingest"],
        ["ingest", "a", "--roi", "1:2"],
        ["fit", "--budget", "soon"],
        ["fit", "--holdout", "1"],
    ],
)
def test_wrong_usage_exits_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert call(*arguments) == 2
    assert "Usage:" in capsys.readouterr().err


def test_wrong_usage_is_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("ingest", "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["type"] == "usage"


def test_debug_shows_where(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("ingest", "nowhere", "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_fault_of_ours_is_told_from_a_fault_of_the_file(
    monkeypatch: pytest.MonkeyPatch, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("btfkit.cli.info.described", lambda path: {}["missing"])
    assert call("info", store) == 1
    assert "KeyError: 'missing' (a fault in btfkit; --debug shows where)" in capsys.readouterr().err


def test_a_full_disk_is_an_error_of_its_own(
    monkeypatch: pytest.MonkeyPatch, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(places, "to_disk", full)
    assert call("ingest", store, "-o", tmp_path / "b.btf.zarr") == 1
    assert "No space left on device" in capsys.readouterr().err
    assert not (tmp_path / "b.btf.zarr").exists()


def test_a_store_can_be_ingested_again_in_part(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.btf.zarr"
    assert (
        call("ingest", store, "-o", out, "--roi", "2:6,:4", "--lights", "0:6:2", "--texel-mm", 0.5)
        == 0
    )
    assert "3 textures of 4 x 4, 3 channels" in capsys.readouterr().out
    assert call("info", out, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["provenance"]["options"] == {
        "texel_mm": 0.5, "rows": [2, 6, None], "cols": [None, 4, None], "lights": [0, 6, 2]
    }  # fmt: skip
    assert len(data["provenance"]["hash"]["sha256"]) == 64
    assert data["texel_mm"] == 0.5


def test_an_output_is_replaced_only_with_force(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again.btf.zarr"
    assert call("ingest", store, "-o", out) == 0
    assert call("ingest", store, "-o", out) == 1
    assert "exists; --force" in capsys.readouterr().err
    assert call("ingest", store, "-o", out, "--force") == 0


def test_an_option_that_a_format_lacks_is_refused_with_those_it_has(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("ingest", store, "--transfer", "srgb") == 1
    assert "format zarr has no option transfer; it has none" in capsys.readouterr().err


@pytest.mark.parametrize("stores", [0, 2])
def test_fit_without_a_source_lists_the_stores_and_how_to_name_one(
    stores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for index in range(stores):
        (tmp_path / f"s{index}.btf.zarr").mkdir()
    assert call("fit", "--model", "lambert") == 1
    listing = "s0.btf.zarr, s1.btf.zarr" if stores else "none"
    remedy = "name one" if stores else "first: btfkit ingest"
    assert (
        f"stores in this folder: {listing}; expected exactly one; {remedy}"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_interruption_exits_130_and_keeps_what_was_finished(tmp_path: Path) -> None:
    script = textwrap.dedent(
        """
        import signal, sys, time, numpy as np
        # Whoever runs the tests in the background has it ignored, and passes that on.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from btfkit import io
        from btfkit.btf import BTF
        from btfkit.cli import main
        from btfkit.io.store import writer
        from btfkit.textures import Textures
        writer._SHARD_BYTES = 1
        class Slow(Textures):
            shape = (50, 4, 4, 1)
            def _read(self, index):
                if index == 5: print("five", flush=True)
                if index > 5: time.sleep(0.2)
                return np.full((4, 4, 1), index, np.float32)
        up = np.tile([0, 0, 1.0], (50, 1))
        io.open = lambda *a, **k: BTF(Slow(), up, up, channels=("550",))
        io.detect = lambda path: "zarr"
        sys.argv = ["btfkit", "ingest", ".", "-o", "a.btf.zarr", "--jobs", "1"]
        main()
        """
    )
    command = [sys.executable, "-c", script]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"five\n"
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        said = process.stderr.read()
        assert process.wait(30) == 130, said
        assert b"interrupted; what was finished is kept" in said
    assert not (tmp_path / "a.btf.zarr").exists()
    assert (tmp_path / ".a.btf.zarr.partial" / "journal.jsonl").is_file()


def test_values_that_json_lacks_are_spelled_out() -> None:
    data = {"a": float("inf"), "b": [np.float32("nan"), np.int64(3)], "c": Path("x"), "d": -np.inf}
    assert plain(data) == {"a": "inf", "b": ["nan", 3], "c": "x", "d": "-inf"}


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (SliceType(), "2:9:3", slice(2, 9, 3)),
        (SliceType(), "-1", slice(-1, None)),
        (SliceType(), "4", slice(4, 5)),
        (SliceType(), ":5", slice(None, 5)),
        (WindowType(), "1:2,3:4", (slice(1, 2), slice(3, 4))),
        (DurationType(), "5m", 300.0),
        (DurationType(), "0.5h", 1800.0),
        (DurationType(), "7", 7.0),
        (SettingType(), "levels=3", ("levels", "3")),
    ],
)
def test_option_values_are_read(kind: click.ParamType, text: str, value: object) -> None:
    assert kind.convert(text, None, None) == value


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        (SliceType(), "1:2:0", "step 0"),
        (SliceType(), "a:b", "no slice"),
        (WindowType(), "1:2", "no window"),
        (DurationType(), "0s", "no time"),
        (DurationType(), "inf", "no time"),
        (SettingType(), "levels", "expected key=value"),
    ],
)
def test_option_values_that_are_none_are_refused(
    kind: click.ParamType, text: str, message: str
) -> None:
    with pytest.raises(click.BadParameter, match=message):
        kind.convert(text, None, None)


def test_an_interruption_that_a_library_wrapped_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrapped(*_: object, **__: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("cannot schedule new futures") from error

    monkeypatch.setattr("btfkit.open", wrapped, raising=False)
    assert call("convert", "a", "-o", "b", "--as", "utia") == 130


def test_a_light_behind_the_sample_is_a_black_picture_and_said_to_be_one(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("render", store, "--size", "8x8", "-o", tmp_path / "a.png", "--force")
    assert call(*asked, "--light", "95,0") == 0
    assert "no light reaches what is seen: the picture is black" in capsys.readouterr().err
    assert call(*asked, "--light", "20,0") == 0
    assert "black" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "incomplete", "offered"),
    [
        ([], "ren", [("plain", "render")]),
        (["fit"], "--resu", [("plain", "--resume")]),
        (["fit", "--model"], "neum", [("plain", "neumip"), ("plain", "neumip-paper")]),
        (["bench", "--model"], "compo", []),
        (["ingest", "--format"], "ubo20", [("plain", "ubo2003")]),
        # The shell lists files itself.
        (["fit"], "wo", [("file", "wo")]),
        (["ingest", "wool.zip", "-o"], "wo", [("file", "wo")]),
    ],
)
def test_a_shell_completes_verbs_options_names_and_files(
    typed: list[str], incomplete: str, offered: list[tuple[str, str]]
) -> None:
    completion = BashComplete(btfkit, {}, "btfkit", "_BTFKIT_COMPLETE")
    found = completion.get_completions(typed, incomplete)
    assert [(item.type, item.value) for item in found] == offered
