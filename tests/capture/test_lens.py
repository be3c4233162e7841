"""Test that photos are undistorted by the lens that their file names, against pycolmap in float64, and that no other lens is guessed."""

import cv2
import numpy as np
import pycolmap
import pytest

from refgs.capture import read_cameras, read_capture
from refgs.capture.images import load_view
from refgs.capture.lens import Lens
from refgs.errors import InputError
from refgs.formats.colmap import MODELS
from tests.makers.captures import colmap, edit, nerfstudio, write

SIZE = 64, 48
FOCAL, CENTRE = (40.0, 42.0), (31.0, 25.0)
COEFFICIENTS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.1,),
    "RADIAL": (-0.1, 0.02),
    "OPENCV": (-0.1, 0.02, 0.004, -0.003),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.01, -0.003),
    "FULL_OPENCV": (0.1, 0.02, 0.004, -0.003, 0.01, 0.3, 0.05, 0.02),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (0.04,),
    "RADIAL_FISHEYE": (0.04, -0.02),
    "THIN_PRISM_FISHEYE": (0.05, -0.02, 0.004, -0.003, 0.01, -0.003, 0.002, 0.005),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.05, -0.02, 0.01, -0.003, 0.001, 0.002, 0.004, -0.003, 0.002, 0.001, 0.005, 0.003),
    "SIMPLE_DIVISION": (-0.1,),
    "DIVISION": (-0.1,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
}
JSON = {  # keys of the coefficients in a transforms.json, in COLMAP's order
    "FULL_OPENCV": "k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV": "k1 k2 p1 p2",
    "SIMPLE_FISHEYE": "",
    "FISHEYE": "",
    "SIMPLE_RADIAL_FISHEYE": "k1",
    "RADIAL_FISHEYE": "k1 k2",
    "OPENCV_FISHEYE": "k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "FOV": "omega",
}


def parameters(model):
    """Return the parameters of COLMAP's model for the tests' photo."""
    single = dict(MODELS.values())[model].startswith("f ")
    return [*(FOCAL[:1] if single else FOCAL), *CENTRE, *COEFFICIENTS[model]]


def truth(model):
    return pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=parameters(model))


def pixels(camera):
    """Return the pixels' centres (H·W, 2) of a camera, and their rays (H·W, 3) with a depth of 1."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    at = np.stack([u, v], axis=-1).reshape(-1, 2)
    return at, np.column_stack([(at - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(at))])


def check(view, camera):
    """Check that a view's undistorted pixels come from where pycolmap's `camera` sees them, and that none is outside of the photo."""
    expected = camera.img_from_cam(pixels(view.camera)[1])
    if view.lens is None:
        np.testing.assert_allclose(pixels(view.camera)[0], expected, atol=1e-9)
        return
    x, y = view.lens.distort(*pixels(view.camera)[1][:, :2].T)
    found = np.column_stack([view.lens.fx * x + view.lens.cx, view.lens.fy * y + view.lens.cy])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    maps = np.stack(view.lens.maps(view.camera), axis=-1).reshape(-1, 2) + 0.5
    np.testing.assert_allclose(maps, expected, atol=1e-4)
    assert (expected >= -0.01).all() and (expected <= np.add(SIZE, 0.01)).all()
    # The inverse, as masks are drawn into the photo. A fisheye's corners may be at 90° or more: a pinhole does not see them.
    at = pixels(view.camera)[0]
    rays = camera.cam_from_img(at)
    known = np.hypot(*(camera.img_from_cam(np.column_stack([rays, np.ones(len(at))])) - at).T) < 1e-3
    back = np.stack(view.lens.maps_back(view.camera), axis=-1).reshape(-1, 2) + 0.5
    wanted = rays * (view.camera.fx, view.camera.fy) + (view.camera.cx, view.camera.cy)
    near = known & (np.abs(wanted) < 500).all(axis=1)
    assert near.mean() > 0.5
    np.testing.assert_allclose(back[near], wanted[near], atol=0.02)


def test_the_models_are_colmaps():
    for number, (name, names) in MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(0, name, 1.0, 2, 2)
        assert int(camera.model) == number and camera.params_info.replace(",", " ").split() == names.split()
    assert {*(name for name, _ in MODELS.values())} == {*pycolmap.CameraModelId.__members__} - {"INVALID"}


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", COEFFICIENTS)
def test_every_lens_of_colmap(tmp_path, model, binary):
    number = next(number for number, (name, _) in MODELS.items() if name == model)
    folder = colmap(tmp_path, binary, (number, model, parameters(model)), count=4)
    for path in (folder / "images").iterdir():
        write(path, np.full((48, 64, 3), 255, np.uint8))
    view = read_capture(folder).views[0]
    check(view, truth(model))
    assert load_view(view, None).image.min() == 255


@pytest.mark.parametrize("model", JSON)
def test_every_lens_of_a_json_file(tmp_path, model):
    folder = nerfstudio(tmp_path, 4)
    focal, centre = (
        dict(zip(("fl_x", "fl_y"), parameters(model), strict=False)),
        dict(zip(("cx", "cy"), CENTRE, strict=True)),
    )
    if model in ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        focal = {"fl_x": FOCAL[0], "fl_y": FOCAL[0]}
    lens = dict(zip(JSON[model].split(), COEFFICIENTS[model], strict=True))
    edit(folder / "transforms.json", lambda data: data.update(focal | centre | lens | {"camera_model": model}))
    check(read_capture(folder).views[0], truth(model))
    view = read_capture(folder).views[0]
    assert read_cameras(folder / "transforms.json")[0].fx == view.camera.fx


def test_is_fisheye(tmp_path):
    """Check that instant-ngp's key gives OpenCV's fisheye, against cv2."""
    folder = nerfstudio(tmp_path, 4)
    lens = dict(zip(("k1", "k2", "k3", "k4"), COEFFICIENTS["OPENCV_FISHEYE"], strict=True))
    edit(folder / "transforms.json", lambda data: data.update(lens | {"is_fisheye": True}))
    view = read_capture(folder).views[0]
    matrix = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    rays = pixels(view.camera)[1][:, None]
    expected = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array([*lens.values()]))[0][:, 0]
    maps = np.stack(view.lens.maps(view.camera), axis=-1).reshape(-1, 2) + 0.5
    np.testing.assert_allclose(maps, expected, atol=1e-4)


def test_browns_k4_is_of_r8(tmp_path):
    folder = nerfstudio(tmp_path, 4)
    lens = {"k1": -0.1, "k2": 0.02, "k3": -0.01, "k4": 0.05}
    edit(folder / "transforms.json", lambda data: data.update(lens | {"camera_model": "OPENCV"}))
    view = read_capture(folder).views[0]
    _, rays = pixels(view.camera)
    r2 = (rays[:, :2] ** 2).sum(axis=1)
    factor = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(lens.values()))
    maps = np.stack(view.lens.maps(view.camera), axis=-1).reshape(-1, 2) + 0.5
    np.testing.assert_allclose(maps, rays[:, :2] * factor[:, None] * 60 + (32, 24), atol=1e-4)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("model", ["THIN_PRISM_FISHEYE", "OPENCV", "FULL_OPENCV"])
def test_a_lens_turns_with_its_photo(model, turns):
    """Check that a ray that is turned with the photo comes to the turned pixel."""
    own = "BROWN" if model == "OPENCV" else model
    k1, k2, p1, p2 = COEFFICIENTS["OPENCV"]
    lens = Lens(*FOCAL, *CENTRE, own, (k1, k2, 0, 0, p1, p2) if model == "OPENCV" else COEFFICIENTS[model])
    width, height = SIZE
    ray, (u, v) = (0.3, -0.2), truth(model).img_from_cam(np.array([0.3, -0.2, 1.0]))
    for _ in range(turns):
        lens = lens.turned(height)
        ray, (u, v), (width, height) = (-ray[1], ray[0]), (height - v, u), (height, width)
    x, y = lens.distort(*ray)
    np.testing.assert_allclose((lens.fx * x + lens.cx, lens.fy * y + lens.cy), (u, v), atol=1e-9)
    np.testing.assert_allclose(lens.undistort(x, y), ray, atol=1e-9)


def test_what_a_pinhole_does_not_see_is_put_outside():
    """Check that the corners of a fisheye photo, beyond 90° from the axis, are not drawn from the middle of a mask."""
    lens = Lens(20.0, 20.0, 32.0, 24.0, "OPENCV_FISHEYE", (0.0,) * 4)
    x, y = lens.undistort(np.array([-1.6, 0.5]), np.array([-0.1, 0.0]))
    assert x[0] < -100 and y[0] < -10
    np.testing.assert_allclose((x[1], y[1]), (np.tan(0.5), 0), atol=1e-9)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model is EQUIRECTANGULAR"),
        ({"camera_model": "SPHERICAL"}, "camera_model is SPHERICAL"),
        ({"camera_model": "VR180_L"}, "camera_model is VR180_L"),
        ({"camera_model": "ORTHOPHOTO"}, "camera_model is ORTHOPHOTO"),
        ({"camera_model": "FISHEYE624"}, "camera_model is FISHEYE624"),
        ({"camera_model": "OMNIDIRECTIONALSTEREO_R"}, "camera_model is OMNIDIRECTIONALSTEREO_R"),
        ({"camera_model": "Brown 5"}, "camera_model is Brown 5"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye is true, but camera_model is OPENCV"),
        ({"camera_type": "fisheye"}, "camera_type is fisheye"),
        ({"projection": "equirectangular"}, "projection is equirectangular"),
        ({"equirectangular": True}, "equirectangular is True"),
        ({"latlong": True}, "latlong is True"),
        ({"orthographic": 1}, "orthographic is 1"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 is 0.1"),
        ({"k5": 0.1}, "k5 is 0.1"),
        ({"k6": 1e-9}, "k6 is 1e-09"),
        ({"s1": 0.01}, "s1 is 0.01"),
        ({"tau1": 0.01}, "tau1 is 0.01"),
        ({"b1": 0.01}, "b1 is 0.01"),
        ({"distortion_params": [0, 0, 0.1]}, "distortion_params is [0, 0, 0.1]"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 is 0.1"),
        ({"camera_model": "FISHEYE", "k1": 0.1}, "k1 is 0.1"),
        ({"camera_model": "FOV"}, "omega is missing"),
        ({"k1": 10**400}, "the distortion coefficient k1 is 1000"),
        ({"K1": 0.1}, "K1 is 0.1"),
        ({"camera_model": "RAD_TAN_THIN_PRISM_FISHEYE", "k1": 0.1}, "k0 is missing"),
        ({"k1": "much"}, "k1 should be a valid number"),
        ({"k1": float("nan")}, "the distortion coefficient k1 is nan"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 1e308}, "the distortion coefficient k1 is 1e+308"),
    ],
)
@pytest.mark.parametrize("shared", [True, False])
def test_what_is_not_known_is_named(tmp_path, values, says, shared):
    folder = nerfstudio(tmp_path, 4)
    edit(folder / "transforms.json", lambda data: (data if shared else data["frames"][1]).update(values))
    with pytest.raises(InputError, match=r"transforms\.json, frame images/000") as said:
        read_capture(folder)
    assert says in str(said.value) and "\n" not in str(said.value)


@pytest.mark.parametrize(
    "values",
    [
        {"k5": 0, "s1": 0.0, "b1": None, "is_fisheye": False, "equirectangular": False, "camera_type": "perspective"},
        {
            "distortion": {"k1": 0.0},
            "distortion_params": [0, 0, 0, 0],
            "distortion_model": "OPENCV",
            "undistorted": True,
        },
        {
            "camera_model": None,
            "lens_model": "iPhone 15 back camera 6.765mm f/1.78",
            "sharpness": 31.4,
            "colmap_im_id": 3,
        },
        {"camera_model": "FULL_OPENCV"},
    ],
)
def test_zeros_and_other_keys_change_nothing(tmp_path, values):
    folder = nerfstudio(tmp_path, 4)
    edit(folder / "transforms.json", lambda data: data.update(values))
    assert all(view.lens is None for view in read_capture(folder).views)


@pytest.mark.parametrize("binary", [True, False])
def test_a_spherical_camera_of_colmap_is_named(tmp_path, binary):
    folder = colmap(tmp_path, binary, (17, "EQUIRECTANGULAR", [64.0, 48.0]))
    with pytest.raises(InputError, match=r"0000\.png: COLMAP's camera model EQUIRECTANGULAR .*image_undistorter"):
        read_capture(folder)


def test_a_later_model_of_colmap_is_named(tmp_path):
    with pytest.raises(InputError, match=r"cameras\.bin: camera model number 99 .*image_undistorter"):
        read_capture(colmap(tmp_path / "a", True, (99, "LATER", [60.0, 32.0, 24.0])))
    with pytest.raises(InputError, match=r"camera model LATER .*image_undistorter"):
        read_capture(colmap(tmp_path / "b", False, (99, "LATER", [60.0, 32.0, 24.0])))
