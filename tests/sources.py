"""A small valid source of every format, made on the spot: what the format contracts run on."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from btfkit import directions
from btfkit.btf import BTF
from btfkit.io import images, tensorfile, ubo2003, utia
from btfkit.io.bonn import header, pack
from btfkit.io.manifest import reader
from btfkit.io.store import writer

SIZE = (5, 7)
PAIRS = 4


def small_btf(*, channels: tuple[str, ...] = ("R", "G", "B")) -> BTF:
    """Two lights times two views of Bonn's table, values in 0.1 to 0.9, smooth as JPEG likes it."""
    table = directions.bonn81()[[8, 40]]
    light, view = np.repeat(table, 2, axis=0), np.tile(table, (2, 1))
    row, col = np.indices(SIZE)
    ramp = 0.1 + 0.4 * row / SIZE[0] + 0.3 * col / SIZE[1]
    shades = np.linspace(0.7, 1.1, PAIRS)[:, None, None, None]
    tints = np.linspace(1.0, 0.6, len(channels))
    return BTF(
        textures=(shades * ramp[..., None] * tints).astype(np.float32),
        light=light,
        view=view,
        channels=channels,
        texel_mm=0.25,
    )


def png16(texture: np.ndarray) -> bytes:
    codes = np.rint(np.clip(texture, 0, 1) * 65535).astype(np.uint16)
    return cv2.imencode(".png", np.ascontiguousarray(codes[..., ::-1]))[1].tobytes()


def _zarr(folder: Path) -> Path:
    return writer.write(small_btf(), folder / "a.btf.zarr", dtype="float32")


def _axf(folder: Path) -> Path:
    (folder / "a.axf").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64))
    return folder / "a.axf"


def _manifest(folder: Path) -> Path:
    reader.write(small_btf(), folder / "manifest")
    return folder / "manifest"


def _spectral(folder: Path) -> Path:
    btf = small_btf(channels=("400", "500.5", "610", "1000"))
    for pair in range(PAIRS):
        tl, pl = np.degrees(directions.to_angles(btf.light[pair]))
        tv, pv = np.degrees(directions.to_angles(btf.view[pair]))
        name = f"tv{tv:05.1f}_pv{pv:05.1f}_tl{tl:05.1f}_pl{pl:05.1f}.exr"
        (folder / "spectral").mkdir(exist_ok=True)
        images.write_exr(folder / "spectral" / name, btf.texture(pair), btf.channels)
    return folder / "spectral"


def _ubo2003(folder: Path) -> Path:
    ubo2003.write(small_btf(), folder / "ubo2003")
    return folder / "ubo2003"


def _utia(folder: Path) -> Path:
    utia.write(small_btf(), folder / "utia")
    return folder / "utia"


def _materialgan(folder: Path) -> Path:
    folder = folder / "cards"
    folder.mkdir()
    texture = small_btf().texture(0)[:, :5]
    for i in range(PAIRS):
        (folder / f"{i:02d}.png").write_bytes(images.encode_png(texture * (1 - 0.1 * i)))
    rows = "\n".join(f"{0.5 * i:.4f},{-0.25 * i:.4f},16.5" for i in range(PAIRS))
    for name in ("camera_pos.txt", "light_pos.txt"):
        (folder / name).write_text(rows + "\n")
    (folder / "image_size.txt").write_text("6.8480\n")
    (folder / "light_power.txt").write_text("1500.0,1500.0,1400.0\n")
    return folder


def _diligent(folder: Path) -> Path:
    folder = folder / "bearPNG"
    folder.mkdir()
    btf = small_btf()
    names = [f"{i + 1:03d}.png" for i in range(PAIRS)]
    for i, name in enumerate(names):
        (folder / name).write_bytes(png16(btf.texture(i)))
    (folder / "filenames.txt").write_text("\n".join(names))
    vectors = "\n".join(f"{0.1 * i} {-0.2 * i} {1.0}" for i in range(PAIRS))
    (folder / "light_directions.txt").write_text(vectors)
    (folder / "light_intensities.txt").write_text(
        "\n".join(f"{1 + i} {2 + i} {3 + i}" for i in range(PAIRS))
    )
    mask = np.full(SIZE, 255, np.uint8)
    mask[0, :2] = 0
    (folder / "mask.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return folder


def _lp(folder: Path) -> Path:
    folder = folder / "lion"
    (folder / "jpg").mkdir(parents=True)
    btf = small_btf()
    lines = [str(PAIRS)]
    for i in range(PAIRS):
        name = f"jpg/lion head_{i}.jpg"
        (folder / name).write_bytes(images.encode_jpeg(btf.texture(i)))
        lines.append(f"{name} {0.1 * i} {-0.2 * i} {1.0}")
    (folder / "dirs.lp").write_text("\n".join(lines))
    return folder


def _merl(folder: Path) -> Path:
    with (folder / "paint.binary").open("wb") as file:
        file.write(np.array([90, 90, 180], "<i4").tobytes())
        # A sparse file: f_r is 0 but for one bin.
        file.truncate(12 + 3 * 8 * 90 * 90 * 180)
    return folder / "paint.binary"


def _utia_brdf(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    (folder / "m003_carpet01.bin").write_bytes(rng.random(288 * 288 * 3).astype("<f8").tobytes())
    return folder / "m003_carpet01.bin"


def _bonn(folder: Path) -> Path:
    # Factors in quarters: their products are exact, in whatever order they are summed.
    rng = np.random.default_rng(0)
    left = rng.integers(-2, 3, (3 * PAIRS, 4)) / 4
    right = rng.integers(-3, 4, (SIZE[0] * SIZE[1], 4)) / 4
    angles = np.stack(directions.to_angles(directions.bonn81()[[8, 40]]), axis=-1)
    with (folder / "wool.btf").open("wb") as file:
        meta = header.Meta(version=4, setup="dome", ppmm=4.0, cosine=True)
        file.write(pack.head(b"!FMF12FCER", meta, angles, angles, SIZE[::-1]))
        file.write(pack.fmf_head(log=True, most=4))
        pack.write_factors(file, left, np.ones(4), right, scalar=2)
    return folder / "wool.btf"


def _sequence(folder: Path) -> Path:
    """Two places of a camera and two of a lamp; the sensor and the rig as they are stated."""
    from btfkit import counts
    from btfkit.sequence import Frame, save

    rng = np.random.default_rng(8)
    run = folder / "run"
    (run / "frames").mkdir(parents=True)
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    frames = []
    for k in range(PAIRS):
        name = f"frames/{k:03}.png"
        wave = np.sin(columns / (2 + k)) * np.cos(rows / 3.0)
        image = 200 + 800 * (1.2 + wave) + 5 * rng.standard_normal(wave.shape)
        (run / name).write_bytes(counts.encode_png(image.astype(np.uint16)))
        axes = {"ring": 0.4 * (k // 2), "arm": 0.1 + 0.2 * (k % 2)}
        frames.append(Frame(name, "sample", axes, exposure_s=0.01, lamp=1.0, group=k))
    line = {"kind": "rotary", "point_mm": [0, 0, 0]}
    document = {
        "sensor": {"width": 64, "height": 48, "bits": 12, "black": 200, "white": 4095,
                   "gain_e_per_dn": 2.0, "read_noise_e": 3.0},
        "rig": {
            "axes": [{"name": "ring", "direction": [0, 0, 1], **line},
                     {"name": "arm", "direction": [0, 1, 0], **line}],
            "carries": {"camera": ["ring"], "light": ["arm"]},
            "camera": {"position_mm": [0, -60, 100], "focal_px": [400, 400],
                       "centre_px": [31.5, 23.5],
                       "rotation": [[1, 0, 0], [0, -0.857493, -0.514496], [0, 0.514496, -0.857493]]},
            "light": {"position_mm": [0, 0, 200]},
        },
        "target": {"sample": {"size_mm": [7, 6]}},
    }  # fmt: skip
    save(run, frames, document)
    return run


def _rgl(folder: Path) -> Path:
    rng = np.random.default_rng(0)

    def grid(*shape: int) -> np.ndarray:
        return rng.uniform(0.2, 1, shape).astype(np.float32)

    fields = {
        "description": np.frombuffer(b"paper", np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": np.linspace(0, 1.4, 4, dtype=np.float32),
        "ndf": grid(5, 6),
        "sigma": grid(4, 3),
        "vndf": grid(1, 4, 6, 5),
        "luminance": grid(1, 4, 4, 4),
        "rgb": grid(1, 4, 3, 4, 4),
        "jacobian": np.ones(1, np.uint8),
    }
    (folder / "paper_rgb.bsdf").write_bytes(tensorfile.packed(fields))
    return folder / "paper_rgb.bsdf"


def _ptm(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    h, w = SIZE
    head = f"PTM_1.2\nPTM_FORMAT_LRGB\n{w}\n{h}\n1.5 1 1 2 1 2\n120 130 125 128 127 0\n"
    body = rng.integers(0, 256, 9 * h * w, dtype=np.uint8)
    (folder / "coin.ptm").write_bytes(head.encode() + body.tobytes())
    return folder / "coin.ptm"


def _hsh(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    h, w = SIZE
    head = f"#HSH1.2\r\n3\r\n{w} {h} 3\r\n9 2 1\r\n".encode()
    table = rng.uniform(0.1, 0.5, (2, 9)).astype("<f4").tobytes()
    body = rng.integers(0, 256, 27 * h * w, dtype=np.uint8).tobytes()
    (folder / "coin.rti").write_bytes(head + table + body)
    return folder / "coin.rti"


def _bme(folder: Path) -> Path:
    head = '#sample_name "paper"\n#format: theta phi BRDF\n#intheta 40\n#inphi 30\n'
    rows = [f"{5 + 20 * i} {90 * i} {0.1 + 0.02 * i}\n" for i in range(PAIRS)]
    (folder / "paper.txt").write_text(head + "".join(rows))
    return folder / "paper.txt"


def _hdf5(folder: Path) -> Path:
    import h5py

    btf = small_btf()
    with h5py.File(folder / "leather_full.hdf5", "w") as file:
        file["ground_light"] = btf.light[:, :2]
        file["ground_camera_dir"] = btf.view[:, :2]
        file["ground_color"] = np.stack([btf.texture(i) for i in range(PAIRS)])
    return folder / "leather_full.hdf5"


SOURCES: dict[str, Callable[[Path], Path]] = {
    "zarr": _zarr,
    "sequence": _sequence,
    "axf": _axf,
    "manifest": _manifest,
    "spectral": _spectral,
    "ubo2003": _ubo2003,
    "utia": _utia,
    "materialgan": _materialgan,
    "diligent": _diligent,
    "lp": _lp,
    "merl": _merl,
    "rgl": _rgl,
    "bonn": _bonn,
    "utia_brdf": _utia_brdf,
    "hdf5": _hdf5,
    "ptm": _ptm,
    "hsh": _hsh,
    "bme": _bme,
}
# Folders of images: each may as well come as a zip.
FOLDERS = ("manifest", "spectral", "ubo2003", "utia", "materialgan", "diligent", "lp")


def zipped(folder: Path) -> Path:
    """The folder as a zip beside it."""
    archive = folder.with_name(folder.name + ".zip")
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            file.write(path, f"outer/{path.relative_to(folder).as_posix()}")
    return archive


def copied(source: Path, to: Path) -> Path:
    """A copy of a file or folder in the folder `to`."""
    if source.is_dir():
        return Path(shutil.copytree(source, to / source.name))
    return Path(shutil.copy(source, to / source.name))
