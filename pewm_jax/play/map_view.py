"""The 3D view of the map: its points, the agent's camera and path, and a box to edit."""

from __future__ import annotations

import itertools
import threading

import numpy as np

from pewm_jax.play import picking
from pewm_jax.play.engine import Engine
from pewm_jax.play.serving import viser
from pewm_jax.play.session import Session, pose

DARK, PATH, IMAGINED, BOX, GOAL = (
    (11, 13, 18),
    (255, 196, 87),
    (96, 200, 255),
    (255, 120, 120),
    (140, 255, 170),
)
"""Colours of the background, the path, imagined points, the selected box, and its target."""
HEADROOM_M = 0.35
"""Points this far above the camera count as ceiling, which is hidden by default, metres."""
FRUSTUM_M, WIDE = 0.3, 1.5
"""Length of the agent's camera, metres; and width of a point, in cells."""


class MapView:
    """The 3D scene of a page, with the selected box: ``box_23``, (2, 3) metres, or None."""

    def __init__(self, server: viser.ViserServer):
        self._server, self._lock = server, threading.RLock()
        self.box_23: np.ndarray | None = None
        self.ceiling, self.tint, self.follow = False, False, True
        self._session: Session | None = None
        self._engine: Engine | None = None
        self._points = np.zeros((0, 3), np.float32)
        self._place: object = None
        scene = server.scene
        scene.set_background_image(np.full((4, 4, 3), DARK, np.uint8), format="png")
        none, grey = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
        self._cloud = scene.add_point_cloud(
            "/map",
            none,
            grey,
            point_size=0.02,
            point_shape="circle",
            point_shading="flat",
            visible=False,
        )
        self._path = scene.add_line_segments(
            "/path", np.zeros((1, 2, 3), np.float32), PATH, thickness=3.0, thickness_units="screen"
        )
        self._agent = scene.add_camera_frustum(
            "/agent", fov=np.pi / 2, aspect=1.0, scale=FRUSTUM_M, color=PATH, visible=False
        )
        self.handle = scene.add_transform_controls(
            "/drag",
            scale=0.6,
            active_axes=(True, True, False),
            depth_test=False,
            opacity=0.7,
            visible=False,
        )
        edges = box_edges(np.ones(3))
        self._source = scene.add_line_segments(
            "/box", edges, BOX, thickness=2.5, thickness_units="screen", visible=False
        )
        self.target = scene.add_transform_controls(
            "/target", scale=0.7, depth_test=False, opacity=0.8, visible=False
        )
        self._target = scene.add_line_segments(
            "/target/box", edges, GOAL, thickness=2.5, thickness_units="screen"
        )

    @property
    def points(self) -> np.ndarray:
        """Return the (N, 3) points shown, metres."""
        return self._points

    def show(self, engine: Engine, session: Session, image: np.ndarray | None = None) -> None:
        """Show a drive: its map, the agent with its frame (uint8) in the frustum, and its path."""
        with self._lock:
            before, self._session, self._engine = self._session, session, engine
            with self._server.atomic():
                if before is None or before.world.map is not session.world.map:
                    self._draw_points()
                self._draw_agent(image)
            self._look(before, session)

    def redraw(self) -> None:
        """Draw the points again, after a setting has changed."""
        with self._lock, self._server.atomic():
            if self._session is not None:
                self._draw_points()

    def choose(self, box_23: np.ndarray | None) -> None:
        """Select a box; None clears the selection."""
        with self._lock, self._server.atomic():
            self.box_23 = box_23
            for node in (self._source, self.target):
                node.visible = box_23 is not None
            if box_23 is None:
                return
            edges, middle = box_edges(box_23[1] - box_23[0]), box_23.mean(0)
            self._source.points = self._target.points = edges
            self._source.position = self.target.position = middle
            self.target.wxyz = (1.0, 0.0, 0.0, 0.0)

    def moved(self) -> tuple[tuple[float, float, float], float]:
        """Return the displacement of the dragged box: metres, and degrees about the vertical."""
        assert self.box_23 is not None
        x, y, z = (float(v) for v in np.asarray(self.target.position) - self.box_23.mean(0))
        return (x, y, z), float(np.degrees(_yaw(self.target.wxyz)))

    def dragged(self) -> tuple[float, float, float]:
        """Return the x, y, yaw to which the agent was dragged."""
        x, y, _ = (float(v) for v in self.handle.position)
        return x, y, _yaw(self.handle.wxyz)

    def _draw_points(self) -> None:
        assert self._engine is not None
        assert self._session is not None
        points, colours, observed = self._engine.points(self._session.world)
        if not self.ceiling:
            low = points[:, 2] < pose(self._session)[2, 3] + HEADROOM_M
            points, colours, observed = points[low], colours[low], observed[low]
        if self.tint:
            mixed = (colours * 0.35 + np.asarray(IMAGINED) * 0.65).astype(np.uint8)
            colours = np.where(observed[:, None], colours, mixed)
        self._points = points
        if len(points):
            self._cloud.points, self._cloud.colors = points, colours
        self._cloud.point_size = self._engine.cell_m * WIDE
        self._cloud.visible = bool(len(points))

    def _draw_agent(self, image: np.ndarray | None) -> None:
        assert self._session is not None
        camera, session = pose(self._session), self._session
        intrinsics = np.asarray(session.world.frame.camera.intrinsics_4[0])
        height, width = session.world.frame.depth_THW.shape[1:]
        self._agent.fov = float(2 * np.arctan(height / 2 / intrinsics[1]))
        self._agent.aspect = width / height
        turn = viser.transforms.SO3.from_matrix(camera[:3, :3].astype(np.float64))
        place = camera[:3, 3].astype(np.float64)
        self._agent.wxyz, self._agent.position = turn.wxyz, place
        if image is not None:
            self._agent.image = image
        self._agent.visible = self.handle.visible = True
        self.handle.position = np.append(session.planar_3[:2], place[2])
        self.handle.wxyz = viser.transforms.SO3.from_z_radians(float(session.planar_3[2])).wxyz
        path = session.path_P3
        if len(path) > 1:
            self._path.points = np.stack([path[:-1], path[1:]], 1).astype(np.float32)
        self._path.visible = len(path) > 1

    def _look(self, before: Session | None, now: Session) -> None:
        """Move the browsers' cameras to a new place, and make them follow the agent."""
        here = pose(now)[:3, 3]
        if before is None or before.place is not now.place:
            self.look_from_above()
            return
        shift = here - pose(before)[:3, 3]
        if not self.follow or not np.abs(shift).max() > 0:
            return
        for client in self._server.get_clients().values():
            with client.atomic():
                position, look_at = client.camera.position, client.camera.look_at
                client.camera.position = position + shift
                client.camera.look_at = look_at + shift

    def look_from_above(self) -> None:
        """Look at the agent from behind and above, in all present and future browsers."""
        if self._session is None:
            return
        camera = pose(self._session).astype(np.float64)
        here, ahead = camera[:3, 3], camera[:3, 2] * [1, 1, 0]
        position, look_at = here - 2.6 * ahead + [0, 0, 4.2], here + 0.9 * ahead - [0, 0, 0.9]
        cameras = [self._server.initial_camera]
        cameras += [client.camera for client in self._server.get_clients().values()]
        for one in cameras:
            one.position, one.look_at = tuple(position), tuple(look_at)


def box_edges(size_3: np.ndarray) -> np.ndarray:
    """Return the (12, 2, 3) edges of a box around the origin, metres."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]
    return (corners[np.array(pairs)] * size_3).astype(np.float32)


def eye_of(camera: viser.CameraHandle) -> picking.Eye:
    """Return a browser's camera."""
    turn = viser.transforms.SO3(np.asarray(camera.wxyz)).as_matrix()
    shape = camera.image_width / max(camera.image_height, 1)
    return picking.Eye(np.asarray(camera.position), turn, float(camera.fov), shape)


def _yaw(wxyz: object) -> float:
    """Return the angle about z by which a quaternion turns the x axis, radians."""
    x, y, _ = viser.transforms.SO3(np.asarray(wxyz, np.float64)).as_matrix()[:, 0]
    return float(np.arctan2(y, x))
