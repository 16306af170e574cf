"""Rectification against truth: a texture whose pixels and texels are both integrated exactly."""

import numpy as np
import pytest
import turntables
from scipy import ndimage

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.demosaic import colours_of
from btfkit.calibration.kinematics import Rigid
from btfkit.calibration.merge import Merged
from btfkit.calibration.rectify import Grid, footprints, rectify
from btfkit.native import resample

TEXELS, SCALE, FINE = 64, 3.3, 8
RGGB = np.array([[0, 1], [1, 2]], np.int32)


def fabric(rng, size, scale):
    """A plain weave with fibres, (size, size), `scale` samples a texel."""
    y, x = np.mgrid[:size, :size] / scale
    period = 4.37
    warp, weft = (0.5 + 0.5 * np.sin(2 * np.pi * at / period) for at in (x, y))
    over = (np.floor(2 * x / period) + np.floor(2 * y / period)) % 2 > 0
    fibres = ndimage.gaussian_filter(rng.standard_normal((size, size)), 1.5)
    return np.clip(np.where(over, warp, weft) * 0.6 + 0.2 + 0.12 * fibres / fibres.std(), 0.02, 2)


@pytest.fixture(scope="module")
def cloth():
    """Fine samples: FINE a camera pixel seen from above, and 200 more on every side."""
    scale = SCALE * FINE
    return fabric(np.random.default_rng(0), int(TEXELS * scale) + 400, scale)


def integrated(cloth, rows, columns):
    """Means over the rectangles between edges (in samples)."""
    total = np.cumsum(np.cumsum(np.pad(cloth, ((1, 0), (1, 0))), 0), 1)
    at = ndimage.map_coordinates(total, np.meshgrid(rows, columns, indexing="ij"), order=1)
    area = np.diff(rows)[:, None] * np.diff(columns)
    return np.diff(np.diff(at, axis=0), axis=1) / area


def photographed(cloth, tilt):
    """A far camera's frame at a tilt about y, and (centre of texels, d pixel / d texel)."""
    wide = FINE / np.cos(tilt)
    span = TEXELS * SCALE * FINE
    first = 200 - np.array([20 * FINE, min(20 * wide, 190 // wide * wide)])
    rows = np.arange(first[0], 200 + span + 20 * FINE, FINE)
    columns = np.arange(first[1], min(200 + span + 20 * wide, cloth.shape[1]), wide)
    frame = integrated(cloth, rows, columns)
    middle = 200 + (np.arange(TEXELS) + 0.5) * SCALE * FINE
    place = np.meshgrid((middle - columns[0]) / wide - 0.5, (middle - rows[0]) / FINE - 0.5)
    return (
        frame.astype(np.float32),
        np.stack(place, -1).reshape(-1, 2),
        np.diag([SCALE * np.cos(tilt), SCALE]),
    )


def snr_db(truth, found):
    return 10 * np.log10(np.var(truth) / np.mean((found - truth) ** 2))


def gaussian_texels(cloth, sigma):
    """Texels that a Gaussian of (rows, columns) standard deviations in texels sees."""
    blurred = ndimage.gaussian_filter(cloth, np.array(sigma) * SCALE * FINE, truncate=6)
    middle = 199.5 + (np.arange(TEXELS) + 0.5) * SCALE * FINE
    return ndimage.map_coordinates(blurred, np.meshgrid(middle, middle, indexing="ij"), order=1)


def gaussian(frame, place, slope, threads=None):
    """Footprints of half a texel as `footprints` makes them, for an affine camera."""
    extra = 0.25 * slope @ slope.T - np.eye(2) / 12
    extra = np.diag(np.maximum(np.diag(extra), 0.5**2))
    inverse = np.linalg.inv(extra / resample.KEPT)[[0, 0, 1], [0, 1, 1]]
    shapes = np.tile(inverse.astype(np.float32), (len(place), 1))
    return resample.ewa(frame[..., None], place, shapes, threads=threads).value.reshape(
        TEXELS, TEXELS
    )


@pytest.mark.slow
@pytest.mark.parametrize(("tilt_deg", "least_db"), [(0, 33), (45, 26), (60, 18)])
def test_a_fabric_keeps_its_texture_at_any_tilt_where_bilinear_samples_lose_it(
    cloth, tilt_deg, least_db
):
    frame, place, slope = photographed(cloth, np.radians(tilt_deg))
    truth = gaussian_texels(cloth, (0.5, 0.5))
    assert snr_db(truth, gaussian(frame, place, slope)) >= least_db
    bilinear = ndimage.map_coordinates(frame, place[:, ::-1].T, order=1).reshape(TEXELS, TEXELS)
    assert snr_db(truth, bilinear) < 12


@pytest.mark.parametrize("tilt_deg", [0, 45, 60])
def test_integrated_areas_are_nearer_to_the_means_over_texels_than_dense_bilinear_samples(
    cloth, tilt_deg
):
    frame, place, slope = photographed(cloth, np.radians(tilt_deg))
    edges = 200 + np.arange(TEXELS + 1) * SCALE * FINE
    truth = integrated(cloth, edges, edges)
    shapes = np.tile(slope.astype(np.float32), (len(place), 1, 1))
    area = resample.area(frame[..., None], place, shapes).value.reshape(TEXELS, TEXELS)
    step = (np.arange(8) + 0.5) / 8 - 0.5
    dense = np.mean(
        [
            ndimage.map_coordinates(frame, (place + slope @ [u, v])[:, ::-1].T, order=1)
            for u in step
            for v in step
        ],
        0,
    )
    assert snr_db(truth, area) > snr_db(truth, dense.reshape(TEXELS, TEXELS)) + 2
    # The fibres of this cloth are finer than a pixel: nobody can put them on one side of an edge.
    assert snr_db(truth, area) > 23


@pytest.mark.parametrize("tilt_deg", [0, 75, 80])
def test_a_grating_loses_what_the_stated_footprint_says_where_pixels_are_coarser_than_texels(
    tilt_deg,
):
    size, period = int(TEXELS * SCALE * FINE) + 400, 6.0
    x = np.arange(size) / (SCALE * FINE)
    grating = np.tile(0.5 + 0.4 * np.sin(2 * np.pi * x / period), (size, 1))
    frame, place, slope = photographed(grating, np.radians(tilt_deg))
    found = gaussian(frame, place, slope)
    present = np.maximum(0.25 * np.diag(slope) ** 2 - 1 / 12, 0.25) + 1 / 12
    columns = np.sqrt(present[0]) / slope[0, 0]
    kept = np.exp(-2 * (np.pi * columns / period) ** 2)
    # At 80 degrees a period is 3.4 pixels: what Gaussians between pixels leave differs by some %.
    assert found.std() / (0.4 / np.sqrt(2)) == pytest.approx(
        kept, rel=0.01 if tilt_deg == 0 else 0.06
    )


def near_camera(tilt, distance=260.0):
    matrix = turntables.look_down(distance) @ turntables.turn([0, 1, 0], np.zeros(3), tilt)
    return Rigid(matrix[:3, :3], matrix[:3, 3])


def test_footprints_are_the_wanted_ones_where_the_camera_resolves_them_and_stated_where_not():
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    grid = Grid(32, 32, 0.6)
    np.testing.assert_allclose(footprints(camera, near_camera(0), grid).footprint, 0.5, rtol=1e-5)
    coarse = footprints(camera, near_camera(np.radians(80)), grid)
    longest, shortest = coarse.axes
    # 0.6 mm are 3.5 px across and 0.6 along: along, a pixel and the narrowest Gaussian are left.
    np.testing.assert_allclose(shortest, 0.5, rtol=1e-3)
    expected = np.sqrt(0.5**2 + 1 / 12) / (0.6 * 5.78 * np.cos(np.radians(80)))
    np.testing.assert_allclose(longest.mean(), expected, rtol=0.05)


@pytest.mark.parametrize("tilt_deg", [85, 89])
def test_footprints_at_grazing_views_are_finite_and_integrate_the_texture_whole(tilt_deg):
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    grid = Grid(48, 48, 0.5)
    where = footprints(camera, near_camera(np.radians(tilt_deg)), grid)
    seen = np.isfinite(where.place).all(-1)
    assert seen.all()
    longest, _ = where.axes
    assert np.isfinite(longest).all()
    # Foreshortened texels are seen through as many texels' blur.
    assert longest.min() > 0.3 / np.cos(np.radians(tilt_deg)) / 3
    image = np.full((turntables.HEIGHT, turntables.WIDTH, 1), 0.7, np.float32)
    found = rectify(image, where)
    assert found.valid.all()
    np.testing.assert_allclose(found.value, 0.7, rtol=1e-6)


def test_a_plane_seen_from_below_or_at_its_edge_has_no_texels():
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    image = np.ones((turntables.HEIGHT, turntables.WIDTH, 1), np.float32)
    for tilt in (90, 91, 130):
        found = rectify(image, footprints(camera, near_camera(np.radians(tilt)), Grid(8, 8, 1.0)))
        assert not found.valid.any()
        assert np.isnan(found.value).all()


def test_texels_beyond_the_frame_or_on_unusable_pixels_are_not_valid_and_say_how_much_was_seen():
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    where = footprints(camera, near_camera(0), Grid(40, 40, 6.0))
    image = np.ones((turntables.HEIGHT, turntables.WIDTH, 1), np.float32)
    image[300:360, 400:460] = np.nan
    found = rectify(image, where, variance=np.full_like(image, 0.01))
    assert 0 < found.valid.mean() < 1
    partly = (found.coverage > 0.1) & (found.coverage < 0.9)
    assert partly.any()
    assert np.isnan(found.value[~found.valid]).all()
    assert np.isnan(found.variance[~found.valid]).all()
    np.testing.assert_allclose(found.value[found.valid], 1, rtol=1e-6)


def test_the_variance_of_texels_is_what_repeated_noise_gives():
    rng = np.random.default_rng(1)
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    where = footprints(camera, near_camera(0.6), Grid(24, 24, 0.6))
    rows, columns = where.window(turntables.HEIGHT, turntables.WIDTH)
    shape = (rows.stop - rows.start, columns.stop - columns.start, 1)
    origin = (rows.start, columns.start)
    texels = np.stack(
        [
            rectify(rng.standard_normal(shape).astype(np.float32), where, origin=origin).value
            for _ in range(150)
        ]
    )
    said = rectify(
        np.zeros(shape, np.float32), where, variance=np.ones(shape, np.float32), origin=origin
    ).variance
    # 150 frames of 576 texels with a few neighbours in common: 1 % of the mean variance
    assert texels.var(axis=0).mean() / said.mean() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(("tilt", "texel_mm", "least"), [(0.0, 0.3, 0.65), (0.6, 0.6, 0.85)])
def test_the_variance_of_a_mosaics_texels_is_what_repeated_noise_gives_or_a_little_more(
    tilt, texel_mm, least
):
    rng = np.random.default_rng(7)
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    where = footprints(camera, near_camera(tilt), Grid(20, 20, texel_mm), mosaic=True)
    rows, columns = where.window(turntables.HEIGHT, turntables.WIDTH, margin=4)
    ones = np.ones((rows.stop - rows.start, columns.stop - columns.start), np.float32)
    nothing = np.zeros(ones.shape, np.uint8)
    texels = []
    for _ in range(60):
        noise = rng.standard_normal(ones.shape).astype(np.float32)
        between = colours_of(Merged(noise, ones, nothing), "RGGB")
        found = rectify(
            noise[..., None], where, variance=ones[..., None], sites=RGGB, colours=between,
            origin=(rows.start, columns.start),
        )  # fmt: skip
        texels.append(found.value)
    ratio = np.var(texels, axis=0).mean((0, 1)) / found.variance.mean((0, 1))
    # Detail that other colours lend lessens the noise of kernels of a pixel or two; 60 frames of
    # 400 texels know the mean to 1 %.
    assert (least < ratio).all()
    assert (ratio < 1.03).all()


@pytest.mark.parametrize(("tilt_deg", "least_db"), [(0, 0.3), (45, 0.8)])
def test_colours_between_the_samples_of_a_mosaic_tell_texels_better_than_their_own_samples_alone(
    cloth, tilt_deg, least_db
):
    frame, place, slope = photographed(cloth, np.radians(tilt_deg))
    # Threads of another colour: the ratio of the channels follows the weave.
    tint = np.float32([0.7, 1.0, 0.5]) + np.float32([0.3, 0, -0.2]) * np.square(frame)[..., None]
    picture = frame[..., None] * tint
    tile = np.tile(RGGB, (frame.shape[0] // 2 + 1, frame.shape[1] // 2 + 1))
    tile = tile[: frame.shape[0], : frame.shape[1], None]
    mosaic = np.take_along_axis(picture, tile, axis=2)
    extra = np.maximum(0.25 * np.diag(slope) ** 2 - 1 / 12, 1.0) / resample.KEPT
    shape = np.float32([1 / extra[0], 0, 1 / extra[1]])
    shapes = np.tile(shape, (len(place), 1))
    wanted = resample.ewa(picture, place, shapes).value
    flat = Merged(mosaic[..., 0], np.ones_like(frame), np.zeros(frame.shape, np.uint8))
    between = colours_of(flat, "RGGB", balance=picture.mean((0, 1)))
    alone = resample.ewa(mosaic, place, shapes, sites=RGGB).value
    full = resample.ewa(mosaic, place, shapes, sites=RGGB, colours=between).value
    gain = [snr_db(wanted[:, c], full[:, c]) - snr_db(wanted[:, c], alone[:, c]) for c in (0, 1, 2)]
    # Most where kernels are narrowest; fibres are finer than pixels, and their colours differ.
    assert min(gain) > 0.1
    assert np.mean(gain) > least_db, gain


def test_a_window_of_the_frame_gives_the_same_texels_as_the_whole_frame():
    rng = np.random.default_rng(2)
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    grid = Grid(64, 64, 0.5).window(slice(10, 30), slice(5, 50))
    where = footprints(camera, near_camera(0.7), grid, mosaic=True)
    image = rng.random((turntables.HEIGHT, turntables.WIDTH, 1)).astype(np.float32)
    rows, columns = where.window(turntables.HEIGHT, turntables.WIDTH)
    assert rows.stop - rows.start < 200
    whole = rectify(image, where, sites=RGGB)
    part = rectify(image[rows, columns], where, sites=RGGB, origin=(rows.start, columns.start))
    np.testing.assert_array_equal(part.value, whole.value)
    assert part.value.shape == (20, 45, 3)
    plane = Merged(image[..., 0], image[..., 0], np.zeros(image.shape[:2], np.uint8))
    between = colours_of(plane, "RGGB")
    whole = rectify(image, where, sites=RGGB, colours=between)
    wide = where.window(turntables.HEIGHT, turntables.WIDTH, margin=4)
    plane = Merged(*(part[wide] for part in (plane.radiance, plane.variance, plane.validity)))
    between = colours_of(plane, "RGGB")
    origin = wide[0].start, wide[1].start
    part = rectify(image[wide], where, sites=RGGB, colours=between, origin=origin)
    # The same filters of 7 x 7; sums of a larger picture may round otherwise.
    np.testing.assert_allclose(part.value, whole.value, rtol=1e-5)


def test_the_texels_of_a_window_are_those_of_the_grid():
    grid = Grid(10, 12, 0.5)
    part = grid.window(slice(2, 5), slice(3, 9))
    np.testing.assert_array_equal(part.points(), grid.points()[2:5, 3:9])
    np.testing.assert_allclose(grid.points()[0, 0], [-2.75, 2.25, 0])
    with pytest.raises(ValueError, match="is none"):
        Grid(10, 10, 0.0)


def test_a_relief_is_looked_for_where_parallax_puts_it():
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    grid, pose = Grid(8, 8, 1.0), near_camera(0.8)
    raised = footprints(camera, pose, grid, height_mm=np.full((8, 8), 2.0))
    expected = turntables.project(
        turntables.apply(
            np.vstack([np.c_[pose.rotation, pose.translation], [0, 0, 0, 1]]),
            grid.points() + [0, 0, 2],
        )
    )
    np.testing.assert_allclose(raised.place, expected, atol=1e-9)


def hostile(rng):
    image = rng.random((40, 50, 3)).astype(np.float32)
    image[5, 7], image[20, 20:25, 1] = np.nan, np.inf
    place = rng.uniform(-4, 54, (200, 2))
    place[3], place[4] = np.nan, 1e12
    sides = rng.normal(0, 1.5, (200, 2, 2))
    inverse = np.linalg.inv(sides @ sides.transpose(0, 2, 1) + 0.3 * np.eye(2))
    packed = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1).astype(np.float32)
    packed[5], packed[6], packed[7] = [1, 2, 1], [0, 0, 1], np.nan
    return (
        image,
        rng.random(image.shape).astype(np.float32),
        place,
        packed,
        sides.astype(np.float32),
    )


needs_kernel = pytest.mark.skipif(
    resample.native.load("resample") is None, reason="kernel not built"
)


@needs_kernel
@pytest.mark.parametrize("mosaic", [False, True])
def test_the_kernel_of_gaussians_is_its_twin_on_random_and_hostile_input(mosaic):
    image, variance, place, inverse, _ = hostile(np.random.default_rng(3))
    sites = np.array([[0, 1], [1, 2]], np.int32) if mosaic else None
    depth = 1 if mosaic else 3
    given = image[..., :depth], place, inverse
    for threads, colours in ((1, None), (3, image if mosaic else None)):
        beside = {"variance": variance[..., :depth], "sites": sites, "colours": colours}
        fast = resample.ewa(*given, **beside, threads=threads)
        plain = resample.ewa_plain(*given, **beside)
        for name in fast._fields:
            # float64 sums in another order, stored as float32
            np.testing.assert_allclose(
                getattr(fast, name), getattr(plain, name), rtol=1e-5, atol=1e-6
            )


@needs_kernel
def test_the_kernel_of_areas_is_its_twin_on_random_and_hostile_input():
    image, variance, place, _, sides = hostile(np.random.default_rng(4))
    place, sides = place[5:], sides[5:]
    place[0] = np.nan
    fast = resample.area(image, place, sides, variance=variance, threads=2)
    plain = resample.area_plain(image, place, sides, variance=variance)
    for name in fast._fields:
        np.testing.assert_allclose(getattr(fast, name), getattr(plain, name), rtol=1e-4, atol=1e-5)


@needs_kernel
def test_the_kernel_refuses_arrays_that_do_not_fit():
    module = resample.native.load("resample")
    none, image = np.empty(0, np.float32), np.zeros((4, 4, 1), np.float32)
    out = [np.empty((3, 1), np.float32) for _ in range(3)]
    sites = np.full((2, 2), -1, np.int32)
    with pytest.raises(ValueError, match="shapes do not fit"):
        module.ewa(
            image, none, sites, none, np.zeros((3, 2)), np.zeros((2, 3), np.float32), 14.0, 1, *out
        )
    with pytest.raises(ValueError, match="out does not fit"):
        module.ewa(
            image, none, sites, none, np.zeros((2, 2)), np.zeros((2, 3), np.float32), 14.0, 1, *out
        )
    sites[0, 0] = 1
    with pytest.raises(ValueError, match="a site without a channel"):
        module.ewa(
            image, none, sites, none, np.zeros((3, 2)), np.zeros((3, 3), np.float32), 14.0, 1, *out
        )
    rgb = np.array([[0, 1], [1, 2]], np.int32)
    out = [np.empty((3, 3), np.float32) for _ in range(3)]
    with pytest.raises(ValueError, match="colours do not fit a mosaic of three"):
        module.ewa(
            image, none, rgb, image, np.zeros((3, 2)), np.zeros((3, 3), np.float32), 14.0, 1, *out
        )
