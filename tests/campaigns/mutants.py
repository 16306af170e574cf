"""Structure-aware mutations: files that are whole in form and wrong in one place.

Random bytes die at the first checksum. These parse what they change and put its checksums right, so
that wrong sizes, counts and offsets reach the code behind them.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import mutations
import numpy as np
from numcodecs.checksum32 import CRC32C

Rng = np.random.Generator
INTEGERS = (
    0,
    1,
    -1,
    2,
    3,
    7,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    2**24,
    2**31 - 1,
    -(2**31),
    2**32 - 1,
    2**63,
)
NUMBERS = (
    "0",
    "-1",
    "1e999",
    "nan",
    "-inf",
    "1e-320",
    "99999999999999999999",
    "0x10",
    "1_0",
    "1,5",
    "",
    "٣",
    "1e5",
)
JSON_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 2**70, 1e308, "", "../x", "x" * 300, [], {}, [[[[[]]]]], [None], {"a": 1}, "nan", 0.5,
)  # fmt: skip


def mutate(path: Path, data: bytes, rng: Rng) -> bytes:
    """`data` of a file of that name, changed in one to three places of its structure."""
    for _ in range(int(rng.integers(1, 4))):
        kind = _KINDS.get(path.suffix.lower())
        if "/c/" in path.as_posix() and ".zarr" in path.as_posix():
            kind = _shard
        if kind is None or rng.random() < 0.3:
            data = _bytes(data, rng)
            continue
        try:
            data = kind(data, rng)
        except (
            ValueError,
            KeyError,
            IndexError,
            TypeError,
            AttributeError,
            StopIteration,
            struct.error,
            zlib.error,
            NotImplementedError,
            RuntimeError,
            EOFError,
            zipfile.BadZipFile,
        ):
            # What an earlier change has broken has no structure any more.
            data = _bytes(data, rng)
    return data


def _bytes(data: bytes, rng: Rng) -> bytes:
    at = float(rng.random() ** (6 if rng.random() < 0.5 else 1))
    kind = ("cut", "flip", "put", "insert", "remove")[int(rng.integers(5))]
    what = (
        _pick(rng, mutations.TOKENS) if rng.random() < 0.5 else rng.bytes(int(rng.integers(1, 13)))
    )
    return mutations.Damage(0.0, at, kind, what).of(data)


def _pick(rng: Rng, values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def _integer(rng: Rng, size: int) -> bytes:
    value = int(_pick(rng, INTEGERS)) & (2 ** (8 * size) - 1)
    return value.to_bytes(size, _pick(rng, ("little", "big")))


def _json(data: bytes, rng: Rng) -> bytes:
    document = json.loads(data)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        keys = (
            value
            if isinstance(value, dict)
            else range(len(value))
            if isinstance(value, list)
            else ()
        )
        for key in keys:
            places.append((value, key))
            walk(value[key])

    walk(document)
    if not places:
        return json.dumps(_pick(rng, JSON_VALUES)).encode()
    holder, key = places[int(rng.integers(len(places)))]
    match int(rng.integers(5)):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[str(key) + "x"] = holder.pop(key)
        case 2:
            deep: Any = 1
            for _ in range(int(_pick(rng, (20, 500)))):
                deep = [deep]
            holder[key] = deep
        case 3 if isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool):
            holder[key] = _pick(
                rng, (-holder[key], holder[key] * 2, holder[key] + 1, float("nan"), 10**12)
            )
        case _:
            holder[key] = _pick(rng, JSON_VALUES)
    text = json.dumps(document)
    if rng.random() < 0.1:
        text = text.replace("{", '{"twice": 1, "twice": 2, ', 1)
    return text.encode()


def _text(data: bytes, rng: Rng) -> bytes:
    lines = data.split(b"\n")
    i = int(rng.integers(len(lines)))
    match int(rng.integers(6)):
        case 0:
            del lines[i]
        case 1:
            lines.insert(i, lines[i])
        case 2:
            j = int(rng.integers(len(lines)))
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            lines[i] = lines[i].replace(
                _pick(rng, (b",", b" ", b".")), _pick(rng, (b";", b"\t", b",,", b""))
            )
        case _:
            numbers = list(re.finditer(rb"-?\d+(?:\.\d+)?", lines[i]))
            if numbers:
                found = numbers[int(rng.integers(len(numbers)))]
                value = _pick(rng, NUMBERS).encode()
                lines[i] = lines[i][: found.start()] + value + lines[i][found.end() :]
    return b"\n".join(lines)


def _png(data: bytes, rng: Rng) -> bytes:
    chunks, at = [], 8
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    i = int(rng.integers(len(chunks)))
    name, body = chunks[i]
    match int(rng.integers(7)):
        case 0:
            del chunks[i]
        case 1:
            chunks.insert(i, chunks[i])
        case 2:
            j = int(rng.integers(len(chunks)))
            chunks[i], chunks[j] = chunks[j], chunks[i]
        case 3:
            kind = _pick(
                rng,
                (
                    b"gAMA",
                    b"cHRM",
                    b"sRGB",
                    b"iCCP",
                    b"tRNS",
                    b"eXIf",
                    b"cICP",
                    b"sBIT",
                    b"PLTE",
                    b"acTL",
                ),
            )
            chunks.insert(1, (kind, rng.bytes(int(_pick(rng, (0, 1, 2, 3, 4, 6, 32, 33))))))
        case 4:
            head = bytearray(chunks[0][1])
            if rng.random() < 0.5:
                head[int(rng.integers(8, 13))] = int(_pick(rng, (0, 1, 2, 3, 4, 6, 8, 16, 255)))
            else:
                place = 4 * int(rng.integers(2))
                head[place : place + 4] = _integer(rng, 4)
            chunks[0] = (chunks[0][0], bytes(head))
        case 5:
            for k, (kind, packed) in enumerate(chunks):
                if kind == b"IDAT":
                    raw = _bytes(zlib.decompress(packed), rng)
                    chunks[k] = (kind, zlib.compress(raw))
                    break
        case _:
            chunks[i] = (name, _bytes(body, rng))
    packed = b"".join(
        struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks
    )
    return data[:8] + packed


def _jpeg(data: bytes, rng: Rng) -> bytes:
    segments, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        segments.append((data[at + 1], data[at + 4 : at + 2 + size]))
        at += 2 + size
        if segments[-1][0] == 0xDA:
            break
    scan = data[at:]
    i = int(rng.integers(len(segments)))
    marker, body = segments[i]
    match int(rng.integers(6)):
        case 0:
            del segments[i]
        case 1:
            segments.insert(i, segments[i])
        case 2:
            frame = next(k for k, (m, _) in enumerate(segments) if m in (0xC0, 0xC1, 0xC2))
            head = bytearray(segments[frame][1])
            place = int(rng.integers(len(head)))
            head[place] = int(_pick(rng, (0, 1, 2, 4, 8, 12, 17, 33, 34, 255)))
            segments[frame] = (segments[frame][0], bytes(head))
        case 3:
            segments.insert(
                0,
                (
                    _pick(rng, (0xDD, 0xE1, 0xE2, 0xEE, 0xFE, 0xDC)),
                    rng.bytes(int(rng.integers(0, 40))),
                ),
            )
        case 4:
            scan = _bytes(scan, rng)
        case _:
            segments[i] = (marker, _bytes(body, rng)[:65000])
    head_bytes = b"".join(bytes([0xFF, m]) + struct.pack(">H", len(b) + 2) + b for m, b in segments)
    return data[:2] + head_bytes + scan


def _exr(data: bytes, rng: Rng) -> bytes:
    """A value of the header, or an entry of the table of chunks behind it."""
    at, attributes = 8, []
    while data[at]:
        name_end = data.index(b"\0", at)
        kind_end = data.index(b"\0", name_end + 1)
        size = struct.unpack_from("<i", data, kind_end + 1)[0]
        attributes.append((kind_end + 1, kind_end + 5, size))
        if size < 0:
            raise ValueError("already broken")
        at = kind_end + 5 + size
    out = bytearray(data)
    if rng.random() < 0.25:
        place = at + 1 + 8 * int(rng.integers(4))
        out[place : place + 8] = _integer(rng, 8)
        return bytes(out)
    length_at, start, size = attributes[int(rng.integers(len(attributes)))]
    if rng.random() < 0.2:
        out[length_at : length_at + 4] = _integer(rng, 4)
    elif size >= 4 and rng.random() < 0.7:
        place = start + 4 * int(rng.integers(size // 4))
        out[place : place + 4] = _integer(rng, 4)
    else:
        place = start + int(rng.integers(max(size, 1)))
        out[place] = int(rng.integers(256))
    return bytes(out)


def _zip(data: bytes, rng: Rng) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(info.filename, file.read(info)) for info in file.infolist()]
    i = int(rng.integers(len(members)))
    name, body = members[i]
    flaw = int(rng.integers(8))
    if flaw == 0:
        members[i] = (
            _pick(
                rng,
                ("../../evil", "/etc/evil", "a\\..\\..\\b", "C:\\x", "\x1b[2J", "n\nl", "x" * 300),
            ),
            body,
        )
    elif flaw == 1:
        members.append((name, _bytes(body, rng)))
    elif flaw == 2:
        members[i] = (name.upper(), body)
    elif flaw == 3:
        members[i] = (name, mutate(Path(name), body, rng))
    elif flaw == 4:
        members.append((name + ".zip", data))
    elif flaw == 5:
        del members[i]
    buffer = io.BytesIO()
    method = int(_pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    with zipfile.ZipFile(buffer, "w", method) as file:
        for each, content in members:
            file.writestr(zipfile.ZipInfo(each), content, method)
    packed = bytearray(buffer.getvalue())
    if flaw >= 6:
        # A field of a directory entry: method, sizes, offsets, flags.
        entries = [
            m.start() for m in re.finditer(rb"PK\x01\x02|PK\x05\x06|PK\x03\x04", bytes(packed))
        ]
        place = _pick(rng, entries) + int(rng.integers(4, 40))
        size = int(_pick(rng, (1, 2, 4)))
        packed[place : place + size] = _integer(rng, size)
    return bytes(packed)


def _npz(data: bytes, rng: Rng) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = {info.filename: file.read(info) for info in file.infolist()}
    name = _pick(rng, sorted(members))
    body = members[name]
    if rng.random() < 0.7 and body[:6] == b"\x93NUMPY":
        size = struct.unpack_from("<H", body, 8)[0]
        head = body[10 : 10 + size].decode("latin1")
        swap = _pick(rng, (
            ("<f4", "|O"), ("<f4", "<f8"), ("<f4", ">f4"), ("<f4", "<c8"), ("<f4", "<U9"), ("False", "True"),
            ("(", "(2000000000, "), ("(", "(0, "), ("(", "(-1, "), ("{", "{'x': 1, "), ("{", "__import__('os')"),
        ))  # fmt: skip
        head = head.replace(*swap).rstrip() + "\n"
        members[name] = (
            body[:8] + struct.pack("<H", len(head)) + head.encode("latin1") + body[10 + size :]
        )
    elif rng.random() < 0.5:
        members[
            _pick(rng, ("uv.npy", "light.npy", "rgb.npy", "size.npy", "weight.npy", "x.npy"))
        ] = members.pop(name)
    else:
        members[name] = _bytes(body, rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for each, content in members.items():
            file.writestr(zipfile.ZipInfo(each), content)
    return buffer.getvalue()


def _safetensors(data: bytes, rng: Rng) -> bytes:
    size = struct.unpack_from("<Q", data)[0]
    head, body = data[8 : 8 + size], data[8 + size :]
    if rng.random() < 0.15:
        return struct.pack("<Q", int(_pick(rng, INTEGERS)) & (2**64 - 1)) + head + body
    if rng.random() < 0.5:
        document = json.loads(head)
        notes = document.get("__metadata__", {})
        key = _pick(rng, sorted(notes) or ["x"])
        try:
            notes[key] = _json(notes[key].encode(), rng).decode()
        except ValueError:
            notes[key] = _pick(rng, ("", "sbtf", "pca", "interpolation", "9" * 400, "[" * 5000))
        head = json.dumps(document).encode()
    else:
        head = _json(head, rng)
    return struct.pack("<Q", len(head)) + head + body


def _fields(data: bytes, rng: Rng) -> bytes:
    """A binary header of numbers: an aligned field of its first kilobyte, or the length."""
    if rng.random() < 0.2:
        return data[: int(len(data) * rng.random())]
    out = bytearray(data)
    size = int(_pick(rng, (2, 4, 8)))
    place = int(rng.integers(min(len(data) - 8, 1024)))
    value = _integer(rng, size)
    if rng.random() < 0.3:
        value = struct.pack("<f", float(_pick(rng, (0.0, -1.0, float("nan"), float("inf"), 1e30))))
    out[place : place + len(value)] = value
    return bytes(out)


def _shard(data: bytes, rng: Rng) -> bytes:
    """An entry of a shard's index, or bytes of a chunk, each with its checksum put right."""
    crc = CRC32C(location="end")
    end = len(data) - 4
    # Four pairs, as `sources.SOURCES` writes them.
    index = bytearray(data[end - 64 : end])
    place = 8 * int(rng.integers(len(index) // 8))
    index[place : place + 8] = _integer(rng, 8)
    return data[: end - len(index)] + bytes(crc.encode(bytes(index)))


_KINDS = {
    ".json": _json, ".csv": _text, ".txt": _text, ".lp": _text, ".png": _png, ".jpg": _jpeg, ".exr": _exr,
    ".zip": _zip, ".npz": _npz, ".safetensors": _safetensors, ".btf": _fields, ".binary": _fields, ".bin": _fields,
    ".axf": _fields, ".tif": _fields, ".bmp": _fields, ".hdr": _text,
}  # fmt: skip
