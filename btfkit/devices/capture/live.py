"""A run as it can be watched: a page that reloads itself, with the last frame."""

from __future__ import annotations

import html
import time
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.capture.progress import Progress
from btfkit.files import whole
from btfkit.io.images import encode_png

_EVERY_S = 1.0
_WIDTH = 640
_STYLE = (
    "body{font:16px sans-serif;margin:2em;background:#111;color:#ddd}"
    "td{padding:.2em 1.5em .2em 0}progress{width:100%;height:1.2em}img{max-width:100%}"
)


@final
class Page:
    """`watch.html` and `watch.png` in a folder, renewed at most once a second.

    Args:
        folder: where they lie. black, white: of the sensor, counts.
    """

    def __init__(self, folder: Path, *, black: float, white: float) -> None:
        self._folder = folder
        self._black, self._white = black, white
        self._began = time.monotonic()
        self._written = -_EVERY_S
        self._first_done: int | None = None

    def __call__(self, progress: Progress) -> None:
        """Show how far the run is."""
        now = time.monotonic()
        if self._first_done is None:
            self._first_done = progress.done - 1
        last = progress.done == progress.total
        if now - self._written < _EVERY_S and not last:
            return
        self._written = now
        if progress.image.size:
            picture = previewed(progress.image, black=self._black, white=self._white)
            with whole(self._folder / "watch.png", force=True) as partial:
                partial.write_bytes(encode_png(picture))
        done = max(progress.done - self._first_done, 1)
        left = (progress.total - progress.done) * (now - self._began) / done
        with whole(self._folder / "watch.html", force=True) as partial:
            partial.write_text(_page(progress, left), encoding="utf-8")


def previewed(counts: NDArray[np.uint16], *, black: float, white: float) -> NDArray[np.float32]:
    """(h, w, 1) linear 0..1 of a frame, at most 640 pixels wide, mosaics averaged."""
    grey = counts.mean(-1) if counts.ndim == 3 else counts.astype(np.float32)
    step = 2 * max(1, round(grey.shape[1] / (2 * _WIDTH)))
    h, w = (side // step * step for side in grey.shape)
    small = grey[:h, :w].reshape(h // step, step, w // step, step).mean((1, 3))
    return np.clip((small - black) / (white - black), 0, 1)[..., None].astype(np.float32)


def _page(progress: Progress, left_s: float) -> str:
    drift = "not measured yet"
    if progress.drift is not None:
        drift = f"{100 * progress.drift.level:+.2f} %, {progress.drift.shift_px:.2f} px"
    rows = {
        "now": progress.kind,
        "poses": f"{progress.done} of {progress.total}",
        "frames in this session": str(progress.frames),
        "repeated": str(progress.retries),
        "drift of the reference": drift,
        "time left": f"{left_s / 60:.1f} min",
    }
    table = "".join(
        f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in rows.items()
    )
    over = progress.done == progress.total
    reload = "" if over else '<meta http-equiv="refresh" content="2">'
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'>{reload}"
        f"<title>capture</title><style>{_STYLE}</style></head><body><h1>Capture</h1>"
        f"<progress max='{progress.total}' value='{progress.done}'></progress>"
        f"<table>{table}</table><img src='watch.png?{progress.frames}' alt='last frame'>"
        "</body></html>\n"
    )
