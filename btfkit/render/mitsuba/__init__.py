"""Materials as BSDFs of Mitsuba 3: importing this registers `btfkit` and `btfkit_measured`.

    import mitsuba
    mitsuba.set_variant("llvm_ad_rgb")
    import btfkit.render.mitsuba
    bsdf = mitsuba.load_dict({"type": "btfkit", "filename": "wool.neumip.safetensors"})

`btfkit` takes models, `btfkit_measured` BTFs in any format that is read. A variant is set first;
`btfkit.render.variants.usable` says which run here. Parameters: `filename`; `repeat`, tiles to a
unit of uv (1); `footprint`, texels, where the integrator gives no ray differentials (0.5). The
frame of shading follows dp/du, v points up as meshes have it. f cos is rgb / pi x opacity; what a
material lets pass is a null lobe, from below everything. Other materials are 0 there: `twosided`.
"""

from __future__ import annotations

from btfkit.render.mitsuba.bsdf import register
from btfkit.render.mitsuba.meshes import add_curvature

__all__ = ["add_curvature", "register"]

register()
