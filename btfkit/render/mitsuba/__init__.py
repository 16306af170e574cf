"""Materials as BSDFs of Mitsuba 3: importing this registers the plugin `btfkit`.

    import mitsuba
    mitsuba.set_variant("llvm_ad_rgb")
    import btfkit.render.mitsuba
    bsdf = mitsuba.load_dict({"type": "btfkit", "filename": "wool.neumip.safetensors"})

A variant is set first; `btfkit.render.variants.usable` says which run here. Parameters of
the plugin: `filename`; `repeat`, tiles to a unit of uv (1); `footprint`, texels, where the
integrator gives no ray differentials (0.5). The frame of shading follows dp/du, v points up as
meshes have it. f cos is rgb / pi; seen or lit from below it is 0: wrap it in `twosided`.
"""

from __future__ import annotations

from btfkit.render.mitsuba.bsdf import register

__all__ = ["register"]

register()
