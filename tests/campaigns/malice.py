"""Models and archives made to do harm, and hostile names wherever a name is shown."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
import stat
import struct
import warnings
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.materials import file as model_file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from campaigns.limits import Attempt, Find

NAMES = (
    "\x1b[2J\x1b]0;owned\x07", "a\nb", "$(touch pwned)", "`touch pwned`", "; touch pwned;", "' or '1", '"><script>alert(1)</script>',
    "</script><script>alert(1)</script>", "%s%n", "{0.__class__}", "-rf", "\u202egpj.exe", "x" * 200, "é" * 60, "a\tb", "\\..\\..",
)  # fmt: skip


def _pick(rng: np.random.Generator, values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def malice(folder: Path) -> Attempt:
    """A seed: one hostile model, archive or name, taken through the verbs that show it."""
    home = folder / "home"
    home.mkdir()
    albedo = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    model_file.save(
        Lambert(LambertSpec((4, 4)), {"texture": albedo}, Header((4, 4))),
        folder / "good.safetensors",
    )
    good = (folder / "good.safetensors").read_bytes()
    picture = cv2.imencode(".png", np.full((5, 7, 3), 90, np.uint8))[1].tobytes()

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 5])
        shutil.rmtree(home)
        home.mkdir()
        before = _listing(folder)
        with warnings.catch_warnings(), contextlib.chdir(home):
            warnings.simplefilter("ignore")
            what = (_model, _archive, _named)[seed % 3](home, good, picture, rng)
        if _listing(folder) != before:
            raise Find(f"{what}: something was written outside: {_listing(folder) ^ before}")
        if list(folder.rglob("pwned")):
            raise Find(f"{what}: something was executed")
        return Counter({what: 1})

    return attempt


def _listing(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _call(*arguments: str) -> int:
    """A verb; whatever it prints must be printable, and an error one line."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(command, list(arguments))
    for said in (out.getvalue(), err.getvalue()):
        if bad := re.search(r"[\x00-\x08\x0b-\x1f\x7f\x80-\x9f\u202a-\u202e]", said):
            raise Find(f"{arguments[0]} prints {bad[0]!r}: {said[:200]!r}")
    errors = [line for line in err.getvalue().splitlines() if line.startswith("btfkit: error")]
    if code == 1 and len(errors) != 1:
        raise Find(f"{arguments[0]} says {err.getvalue()[:300]!r}")
    if "a fault in btfkit" in err.getvalue():
        raise Find(f"{arguments[0]}: {errors[0][:400]}")
    if "next: " in err.getvalue():
        shlex.split(err.getvalue().split("next: ", 1)[1])
    return code


def _model(home: Path, good: bytes, picture: bytes, rng: np.random.Generator) -> str:
    size = struct.unpack_from("<Q", good)[0]
    document, body = json.loads(good[8 : 8 + size]), good[8 + size :]
    entry = document["texture"]
    flaw = int(rng.integers(12))
    text: bytes | None = None
    match flaw:
        case 0:
            entry["data_offsets"] = [int(n) for n in rng.integers(-(2**40), 2**40, 2)]
        case 1:
            entry["shape"] = _pick(
                rng, ([2**62, 4], [2**31, 2**31, 3], [-4, 4, 3], [0, 4, 3], [4] * 40, [4, 4, 3.0])
            )
        case 2:
            document["texture2"] = dict(entry)
        case 3:
            entry["dtype"] = _pick(rng, ("F8_E4M3", "O", "U64", "BOOL", "F64", "", None, "F32 "))
        case 4:
            text = b"[" * int(_pick(rng, (1000, 100000)))
        case 5:
            text = (
                json.dumps(document).encode()[:-1]
                + b', "texture": '
                + json.dumps(entry).encode()
                + b"}"
            )
        case 6:
            document["__metadata__"]["model"] = _pick(
                rng, (*NAMES, "../../evil", "os:system", "builtins:eval")
            )
        case 7:
            document["__metadata__"]["spec"] = _pick(
                rng,
                (
                    '{"size": [1e9, 1e9]}',
                    "__import__('os')",
                    "[" * 9999,
                    '{"size": [4, 4], "x": 1}',
                    "null",
                ),
            )
        case 8:
            document["__metadata__"][_pick(rng, ("licence", "provenance", "channels", "wrap"))] = (
                json.dumps(_pick(rng, (list(NAMES), NAMES[6], {"a": NAMES[0]})))
            )
        case 9:
            document["__metadata__"] = _pick(rng, (1, [], {"a": 1}, {"btfkit": None}, {}))
        case 10:
            text = json.dumps(document).encode().replace(b"model", b"mo\xff\xfedel")
        case _:
            entry["data_offsets"] = [0, len(body) + int(rng.integers(1, 2**33))]
    head = text if text is not None else json.dumps(document).encode()
    length = (
        len(head) if rng.random() < 0.9 else int(_pick(rng, (0, 1, 2**31, 2**63 - 1, 2**64 - 1)))
    )
    path = home / "evil.safetensors"
    path.write_bytes(struct.pack("<Q", length) + head + body)
    _call("info", str(path))
    _call("info", str(path), "--json")
    _call("view", str(path), "-o", str(home / "page.html"), "--small")
    _no_script(home / "page.html")
    return "models"


def _archive(home: Path, good: bytes, picture: bytes, rng: np.random.Generator) -> str:
    path = home / "evil.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(3):
            file.writestr(f"tl{10 + 10 * i:03d}_pl000_tv000_pv000.png", picture)
        match int(rng.integers(8)):
            case 0:
                file.writestr(
                    _pick(
                        rng,
                        ("../../pwned", "/tmp/pwned", "..\\pwned", "C:\\pwned", "a/../../pwned"),
                    ),
                    b"x",
                )
            case 1:
                info = zipfile.ZipInfo("tl050_pl000_tv000_pv000.png")
                info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
                file.writestr(info, _pick(rng, ("/etc/passwd", "../../../etc/passwd", "/dev/zero")))
            case 2:
                file.writestr(
                    "tl050_pl000_tv000_pv000.png", bytes(int(_pick(rng, (1 << 20, 1 << 25))))
                )
            case 3:
                file.writestr("tl010_pl000_tv000_pv000.png", picture[:-20])
            case 4:
                for i in range(3000):
                    file.writestr(f"{'d/' * 90}{i}.png", b"")
            case 5:
                file.writestr("manifest.csv", "file,theta\n" + _pick(rng, NAMES) + ",1\n")
            case 6:
                file.writestr(_pick(rng, NAMES) + "/tl050_pl000_tv000_pv000.png", picture)
            case _:
                big = picture[:16] + struct.pack(">II", 60000, 60000) + picture[24:]
                file.writestr("tl050_pl000_tv000_pv000.png", big)
    _call("info", str(path))
    _call("ingest", str(path), "-o", str(home / "out.btf.zarr"), "--jobs", "1", "--no-preview")
    return "archives"


def _named(home: Path, good: bytes, picture: bytes, rng: np.random.Generator) -> str:
    name = _pick(rng, NAMES).replace("/", "_")
    folder = home / name
    folder.mkdir()
    for i in range(3):
        (folder / f"tl{10 + 10 * i:03d}_pl000_tv000_pv000.png").write_bytes(picture)
    if rng.random() < 0.3:
        (folder / "tl050_pl000_tv000_pv000.png").write_bytes(picture[:40])
    source = f"./{name}"
    if _call("ingest", source, "--jobs", "1", "--no-preview") == 0:
        store = next(home.glob("*.btf.zarr"))
        _call("info", f"./{store.name}")
        _call("info", f"./{store.name}", "--json")
        if rng.random() < 0.3:
            _call("view", f"./{store.name}", "-o", "page.html")
            _no_script(home / "page.html")
    return "names"


def _no_script(page: Path) -> None:
    if page.exists() and "<script>alert" in page.read_text(encoding="utf-8"):
        raise Find("the page carries a script that a name brought")
