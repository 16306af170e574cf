"""Mutated inputs over all readers, with a second decoder as judge where there is one."""

from __future__ import annotations

import io as bytes_io
import json
import shutil
import struct
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import mutations
import numpy as np
import sources
import zarr
from PIL import Image

from btfkit import io
from btfkit.errors import BtfkitError
from btfkit.io import images, queryfile
from btfkit.materials import file as model_file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.queries import QuerySet
from btfkit.relief import file as relief_file
from btfkit.relief import procedural
from campaigns import mutants
from campaigns.limits import Attempt, Find

HARMLESS = (BtfkitError, ValueError, OSError)
# Files of megabytes: a change of theirs takes long to write.
_LARGE = {"merl": 25, "utia_brdf": 25}


def readers(folder: Path) -> Attempt:
    """Sources of every format, folders of images as zips too."""
    names = [*sources.SOURCES, *(f"{name}+zip" for name in sources.FOLDERS)]
    made: dict[str, Path] = {}
    for name in names:
        plain, _, packed = name.partition("+")
        home = folder / name
        home.mkdir()
        path = sources.SOURCES[plain](home)
        made[name] = sources.zipped(path) if packed else path

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 1])
        name = names[seed % len(names)]
        if name in _LARGE and rng.integers(_LARGE[name]):
            name = names[int(rng.integers(3))]
        with _changed(made[name], rng) as source:
            return _outcome(lambda: _read(source, name.partition("+")[0], packed="+" in name), name)

    return attempt


class _changed:  # noqa: N801
    """A source with one file changed, moved, doubled or gone; whole again afterwards."""

    def __init__(self, source: Path, rng: np.random.Generator) -> None:
        self._source, self._rng = source, rng
        self._before: list[tuple[Path, bytes | None]] = []

    def __enter__(self) -> Path:
        files = mutations.files_of(self._source)
        path = files[int(self._rng.integers(len(files)))]
        data = path.read_bytes()
        self._before.append((path, data))
        share = self._rng.random() if path != self._source else 1.0
        if share < 0.05:
            path.unlink()
        elif share < 0.12:
            other = path.with_name(_renamed(path.name, self._rng))
            if not other.exists():
                self._before.append((other, None))
                try:
                    path.rename(other)
                except (OSError, ValueError):
                    path.write_bytes(data)
        else:
            path.write_bytes(mutants.mutate(path, data, self._rng))
        return self._source

    def __exit__(self, *_: object) -> None:
        for path, data in reversed(self._before):
            if data is None:
                path.unlink(missing_ok=True)
            else:
                path.write_bytes(data)


def _renamed(name: str, rng: np.random.Generator) -> str:
    digits = [i for i, letter in enumerate(name) if letter.isdigit()]
    if digits and rng.random() < 0.6:
        i = digits[int(rng.integers(len(digits)))]
        return name[:i] + str(int(rng.integers(10))) + name[i + 1 :]
    return ("copy of " + name, name.upper(), name + ".bak", "\x1b[31m" + name, "a\nb" + name)[
        int(rng.integers(5))
    ]


def _outcome(read: Callable[[], Any], name: str) -> Counter[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        try:
            read()
        except Find:
            raise
        except HARMLESS as error:
            _check_message(error)
            return Counter(refused=1)
    return Counter(accepted=1)


def _check_message(error: Exception) -> None:
    message = str(error)
    if not message or len(message) > 1500 or any(ord(c) < 32 or ord(c) == 127 for c in message):
        raise Find(f"the message is {message[:300]!r}") from error
    if "a fault in" in message or "llocate" in message or "bad_alloc" in message:
        raise Find(f"memory: {message[:300]}") from error


def _read(source: Path, name: str, *, packed: bool) -> None:
    try:
        io.detect(source)
    except BtfkitError as error:
        _check_message(error)
    btf = io.open(source, format=name)
    for directions in (btf.light, btf.view):
        # float32
        if not np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-4):
            raise Find("a direction is no unit vector")
    found = {}
    for pair in sorted({*range(min(4, len(btf))), len(btf) - 1}):
        texture = found[pair] = btf.texture(pair)
        if texture.shape != btf.shape[1:] or texture.dtype != np.float32:
            raise Find(f"texture {pair} is {texture.dtype} {texture.shape} in {btf.shape}")
    if name == "zarr":
        _as_zarr_reads(source, found)
    elif packed:
        _as_unpacked(source, name, found)


def _as_zarr_reads(source: Path, found: dict[int, np.ndarray]) -> None:
    """Our own way through a shard against the library's."""
    array = zarr.open_group(source, mode="r")["texture"]
    for pair, texture in found.items():
        try:
            other = np.asarray(array[pair], np.float32)
        except Exception as error:
            raise Find(f"zarr refuses pair {pair}: {error}") from error
        if not np.array_equal(texture, other, equal_nan=True):
            raise Find(f"zarr reads pair {pair} otherwise")


def _as_unpacked(source: Path, name: str, found: dict[int, np.ndarray]) -> None:
    """A zip against the folder that Python's own zipfile unpacks it to."""
    try:
        with zipfile.ZipFile(source) as file:
            members = {info.filename: file.read(info) for info in file.infolist()}
    except Exception:  # a member that no image of ours is: there is no judge
        return
    folder = source.with_name(source.stem + ".unpacked")
    shutil.rmtree(folder, ignore_errors=True)
    for member, data in members.items():
        path = folder / member
        if ".." in Path(member).parts or not member or member.endswith("/"):
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    try:
        btf = io.open(folder, format=name)
        for pair, texture in found.items():
            if not np.array_equal(texture, btf.texture(pair), equal_nan=True):
                raise Find(f"unpacked, pair {pair} reads otherwise")
    except HARMLESS as error:
        raise Find(f"unpacked it is refused: {error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def pictures(folder: Path) -> Attempt:
    """Coded pictures, read by us and by Pillow; lossless ones must agree to the bit."""
    rng = np.random.default_rng(0)
    codes = (rng.random((20, 30, 3)).cumsum(axis=0) * 12).astype(np.uint8)
    made: list[tuple[str, bytes, bool]] = []

    def add(name: str, lossless: bool, **options: Any) -> None:
        picture = Image.fromarray(codes)
        for mode in options.pop("modes", ("RGB",)):
            buffer = bytes_io.BytesIO()
            picture.convert(mode).save(
                buffer,
                options.get("kind", Path(name).suffix[1:]),
                **{k: v for k, v in options.items() if k != "kind"},
            )
            made.append((name, buffer.getvalue(), lossless))

    add("a.png", True, modes=("RGB", "L", "P", "RGBA", "1"))
    add("a.bmp", True, modes=("RGB", "L"))
    add("a.jpg", False, kind="jpeg", quality=95)
    add("a.jpg", False, kind="jpeg", progressive=True)
    for compression in ("tiff_lzw", "tiff_adobe_deflate", "packbits", "raw"):
        add("a.tif", True, kind="tiff", compression=compression)
    made.append(("a.png", cv2.imencode(".png", codes.astype(np.uint16) * 257)[1].tobytes(), True))

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 2])
        name, data, lossless = made[seed % len(made)]
        changed = mutants.mutate(Path(name), data, rng)
        ours: list[images.Image] = []
        counts = _outcome(
            lambda: ours.append(images.decode(name, changed, transfer="linear")), name
        )
        if ours and ours[0].declared is None and ours[0].alpha is None:
            # Colours that a file declares are converted here, and by nobody else; Pillow keeps 8
            # bits of 16 where there are three channels.
            lossless = lossless and (ours[0].depth == np.uint8 or ours[0].linear.shape[2] == 1)
            _judge(name, changed, ours[0].linear, lossless, counts)
        return counts

    return attempt


def _judge(name: str, data: bytes, ours: np.ndarray, lossless: bool, counts: Counter[str]) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(bytes_io.BytesIO(data)) as picture:
                picture.load()
                theirs = _as_float(picture)
    except Exception:  # whatever Pillow raises: there is no judge then
        counts["no second opinion"] += 1
        return
    if theirs is None:
        counts["no second opinion"] += 1
        return
    counts["compared"] += 1
    if theirs.shape[:2] != ours.shape[:2]:
        raise Find(f"{name}: {ours.shape} here, {theirs.shape} by Pillow")
    channels = min(ours.shape[2], theirs.shape[2])
    off = float(np.abs(ours[..., :channels] - theirs[..., :channels]).max())
    # Codes of 8 or 16 bits as float32; of a JPEG, other inverse transforms, and chroma upsampled otherwise.
    if off > (1e-6 if lossless else 0.25):
        raise Find(f"{name}: values differ from Pillow's by {off:.4f}")


def _as_float(picture: Image.Image) -> np.ndarray | None:
    if picture.mode in ("P", "1"):
        picture = picture.convert("RGB")
    if picture.mode in ("L", "RGB", "RGBA"):
        array = np.asarray(picture, np.float32) / 255
    elif picture.mode in ("I;16", "I;16B"):
        array = np.asarray(picture, np.float32) / 65535
    else:
        return None
    if picture.mode == "RGBA" or picture.info.get("transparency") is not None:
        return None  # whether alpha is multiplied out is not Pillow's to say
    return array[..., None] if array.ndim == 2 else array


def tables(folder: Path) -> Attempt:
    """Queries, reliefs and models, each against a plain reading of the same bytes."""
    rng = np.random.default_rng(0)
    up = np.tile(np.array([0, 0, 1], np.float32), (20, 1))
    uv, rgb = rng.random((20, 2), np.float32), rng.random((20, 3), np.float32)
    files = [folder / "q.npz", folder / "r.exr", folder / "m.lambert.safetensors"]
    queryfile.write(QuerySet(uv=uv, light=up, view=up, rgb=rgb, size=(4, 5)), files[0])
    relief_file.write(procedural.make("cobbles", 8), files[1])
    albedo = rng.random((4, 4, 3)).astype(np.float32)
    model_file.save(Lambert(LambertSpec((4, 4)), {"texture": albedo}, Header((4, 4))), files[2])
    read: list[Callable[[Path], Any]] = [_queries, relief_file.read, _model]
    before = [path.read_bytes() for path in files]

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 3])
        which = seed % 3
        path = files[which]
        path.write_bytes(mutants.mutate(path, before[which], rng))
        return _outcome(lambda: read[which](path), path.name)

    return attempt


def _queries(path: Path) -> None:
    found = queryfile.read(path)
    with np.load(path, allow_pickle=False) as file:
        for name in ("uv", "light", "view"):
            ours, theirs = getattr(found, name), np.asarray(file[name], np.float32)
            if len(ours) == len(theirs) and not np.allclose(
                ours, theirs, atol=1e-5, equal_nan=True
            ):
                unit = theirs / np.maximum(np.linalg.norm(theirs, axis=-1, keepdims=True), 1e-30)
                if name == "uv" or not np.allclose(ours, unit, atol=1e-5, equal_nan=True):
                    raise Find(f"{name} differs from numpy's")


def _model(path: Path) -> None:
    material = model_file.load(path)
    data = path.read_bytes()
    size = struct.unpack_from("<Q", data)[0]
    head = json.loads(data[8 : 8 + size])
    for name, array in material.weights.items():
        start, end = head[name]["data_offsets"]
        if array.tobytes() != data[8 + size + start : 8 + size + end]:
            raise Find(f"{name} differs from the bytes of the file")
    rgb = material.evaluate([0.3, 0.4], [0, 0, 1], [0, 0, 1]).reflectance
    if not np.isfinite(rgb).all():
        raise Find("a loaded model answers no finite number")
