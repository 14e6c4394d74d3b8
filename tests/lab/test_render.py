"""The renderer: geometry against closed forms, colours, light and determinism."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from refu_lab.render import Backdrop, RenderMesh, Viewpoint, render, save_png

PLAIN = Backdrop(background=(0.2, 0.4, 0.6), show_ground=False)
BACKGROUND = np.array([51, 102, 153])


def sphere(radius: float = 1.0, centre=(0.0, 0.0, 0.0), colour=(0.8, 0.3, 0.3)) -> RenderMesh:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return RenderMesh(ball.vertices + np.array(centre), ball.faces, colour)


def covered(image: np.ndarray) -> np.ndarray:
    return (image != BACKGROUND).any(2)


@pytest.mark.parametrize(("width", "height"), [(160, 120), (90, 150)])
def test_silhouette_of_a_sphere_is_the_analytic_one(width, height) -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=5.0, yaw=30, pitch=20, vertical_fov=40)
    image = render([sphere()], camera=camera, size=(width, height), samples=1, backdrop=PLAIN)
    # A ray meets the sphere where its angle with the axis is at most asin(r / d).
    half = np.tan(np.radians(20))
    x = (2 * (np.arange(width) + 0.5) / width - 1) * half * width / height
    y = (1 - 2 * (np.arange(height) + 0.5) / height) * half
    expected = np.hypot(*np.meshgrid(x, y)) < np.tan(np.arcsin(1 / 5))
    assert (covered(image) != expected).sum() < 0.02 * expected.sum() ** 0.5 * 2 * np.pi
    assert (image[~covered(image)] == BACKGROUND).all()


def test_image_axes() -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=5.0, yaw=0, pitch=0)
    # From the front the subject's left (+x) is on the right of the picture; up is up.
    for centre, half in (((0.5, 0, 0), np.s_[:, 40:]), ((0, 0.5, 0), np.s_[:30, :])):
        image = render([sphere(0.2, centre)], camera=camera, size=(80, 60), backdrop=PLAIN)
        assert covered(image).any()
        assert covered(image)[half].sum() == covered(image).sum()


def test_nearer_mesh_hides_farther() -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=6.0, yaw=0, pitch=0)
    red, green = sphere(0.5, (0, 0, 1), (0.9, 0.1, 0.1)), sphere(0.5, (0, 0, -1), (0.1, 0.9, 0.1))
    pictures = [render(order, camera=camera, size=(60, 60), backdrop=PLAIN) for order in ([red, green], [green, red])]
    np.testing.assert_array_equal(*pictures)
    middle = pictures[0][30, 30].astype(int)
    assert middle[0] > 2 * middle[1]


def test_light_comes_from_the_sun_and_shadows_fall() -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=5.0, yaw=0, pitch=0)
    lit = Backdrop(show_ground=False, to_sun=(-1.0, 0.6, 0.4))
    image = render([sphere(0.8, colour=(0.5, 0.5, 0.5))], camera=camera, size=(80, 80), backdrop=lit).astype(int)
    assert image[40, 25, 0] > image[40, 55, 0] + 30
    above = Viewpoint.looking_at((0, 0, 0), distance=6.0, yaw=0, pitch=60)
    stage = Backdrop(to_sun=(-1.0, 1.0, 0.0), ground_height=-1.0)
    image = render([sphere(0.5)], camera=above, size=(120, 90), backdrop=stage).astype(int)
    shadow_side, sunny_side = image[45:60, 80:100], image[45:60, 20:40]
    assert shadow_side.min() < sunny_side.min() - 25


def test_vertex_colours_and_open_surfaces() -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=4.0, yaw=0, pitch=0)
    v = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    f = np.array([[0, 1, 2], [0, 2, 3]])
    colours = np.array([[1, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0]], float)
    front = render([RenderMesh(v, f, colours)], camera=camera, size=(60, 60), backdrop=PLAIN).astype(int)
    assert front[30, 18, 0] > front[30, 18, 2]
    assert front[30, 42, 2] > front[30, 42, 0]
    back = render([RenderMesh(v, f[:, ::-1], colours)], camera=camera, size=(60, 60), backdrop=PLAIN).astype(int)
    assert (covered(back) == covered(front)).all()  # the inside is drawn
    assert back[30, 30].sum() < front[30, 30].sum()  # and darker


def test_more_samples_smooth_the_outline() -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=5.0)
    one, many = (render([sphere()], camera=camera, size=(60, 60), samples=n, backdrop=PLAIN) for n in (1, 16))
    assert len(np.unique(many.reshape(-1, 3), axis=0)) > len(np.unique(one.reshape(-1, 3), axis=0))
    assert np.abs(one.astype(int) - many).mean() < 3


def test_framing_shows_everything_and_fills_the_picture() -> None:
    mesh = sphere(0.3, (5.0, -2.0, 1.0))
    for yaw, pitch in ((0, 0), (130, 25), (-60, -30)):
        camera = Viewpoint.framing(mesh.vertices, size=(100, 140), yaw=yaw, pitch=pitch, margin=1.1)
        seen = covered(render([mesh], camera=camera, size=(100, 140), samples=1, backdrop=PLAIN))
        border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
        assert not border.any()
        columns = np.flatnonzero(seen.any(0))
        assert 80 < np.ptp(columns) + 1 < 98
        assert abs(columns.mean() - 49.5) < 2


def test_same_input_same_picture_and_png(tmp_path) -> None:
    camera = Viewpoint.looking_at((0, 0, 0), distance=5.0)
    first, second = (render([sphere()], camera=camera, size=(64, 48)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert first.shape == (48, 64, 3)
    assert first.dtype == np.uint8
    save_png(first, tmp_path / "ball.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "ball.png")), first)
