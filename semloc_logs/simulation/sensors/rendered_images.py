"""Colour pictures of a simulated world: surfaces lit by sun and sky, cast shadows, haze, and what a
camera makes of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.meshes.world import ROAD, Scene
from semloc_logs.simulation.sensors.camera import CameraModel, Hits, first_hits, pixel_rays
from semloc_logs.simulation.sensors.noise import Octaves, octaves
from semloc_logs.simulation.sensors.surface_colours import Surfaces, markings, road_plan, surfaces
from semloc_logs.simulation.sensors.texture import Pixels, colours

_HAZE = 700.0  # m that take away two thirds of the contrast
_BLUR = 0.5  # px of the lens
_NOISE = 1.6  # grey levels of 255 in the middle tones


@dataclass(frozen=True, slots=True)
class Light:
    """The sun's direction (azimuth, elevation in radians) and the colours of sun, sky overhead and
    horizon, linear.
    """

    azimuth: float
    elevation: float
    sun: tuple[float, float, float]
    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]

    @property
    def direction(self) -> F32:
        """Unit vector (3,) to the sun."""
        c = np.cos(self.elevation)
        return np.array(
            [c * np.cos(self.azimuth), c * np.sin(self.azimuth), np.sin(self.elevation)], np.float32
        )


LIGHTS = {
    "noon": Light(-1.3, 0.9, (1.5, 1.42, 1.3), (0.22, 0.42, 0.85), (0.65, 0.75, 0.88)),
    "evening": Light(2.6, 0.22, (1.5, 0.95, 0.5), (0.32, 0.38, 0.55), (0.85, 0.64, 0.48)),
    "overcast": Light(-1.3, 0.9, (0.0, 0.0, 0.0), (0.75, 0.78, 0.82), (0.85, 0.87, 0.9)),
}


class Painter:
    """Pictures of one scene under one condition. Surfaces look the same in all of them; light,
    season and clouds are the condition's.
    """

    def __init__(self, scene: Scene, condition: Condition | None = None) -> None:
        self.scene, self.condition = scene, condition or Condition()
        self.light = LIGHTS[self.condition.daytime]
        self._surfaces, self._plan = surfaces(scene.world), road_plan(scene.world)

    def picture(
        self,
        world_T_camera: F64,
        rng: np.random.Generator,
        model: CameraModel,
        *,
        traffic: Scene | None = None,
        hits: Hits | None = None,
    ) -> U8:
        """RGB (h, w, 3) as seen by the camera at ``world_T_camera`` (4, 4, optical frame);
        ``hits``: :func:`camera.first_hits`.
        """
        rays = pixel_rays(model)
        if hits is None:
            hits = first_hits(self.scene, world_T_camera, rays, traffic)
        linear = self._radiance(hits, rays, world_T_camera, model, traffic)
        return expose(linear, rng)

    def _radiance(
        self, hits: Hits, rays: F32, world_T_camera: F64, model: CameraModel, traffic: Scene | None
    ) -> F32:
        """Linear colours (h, w, 3)."""
        turn = world_T_camera[:3, :3].astype(np.float32)
        place = world_T_camera[:3, 3].astype(np.float32)
        out = np.zeros((hits.depth.size, 3), np.float32)
        seen = np.isfinite(hits.depth).ravel()
        rows = np.flatnonzero(seen)
        open_ = np.flatnonzero(~seen)
        out[open_] = self._sky(rays.reshape(-1, 3)[open_] @ turn.T)
        ray = rays.reshape(-1, 3)[rows]
        depth = hits.depth.ravel()[rows]
        ray = ray @ turn.T
        points = ray * depth[:, None] + place
        normals = hits.normal.reshape(-1, 3)[rows].astype(np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        facing = np.einsum("ij,ij->i", normals, ray)
        footprint = np.asarray(depth / model.focal / np.clip(np.abs(facing), 0.12, 1), np.float32)
        colour, gloss = self._colours(hits, rows, points, normals, footprint, traffic)
        normals *= np.where(facing > 0, np.float32(-1), np.float32(1))[:, None]
        lit = self._lit(points, normals, traffic) * colour
        some = np.flatnonzero(gloss > 0)
        mirrored = ray[some] + 2 * np.abs(facing[some, None]) * normals[some]
        shine = (gloss[some] * (0.25 + 0.75 * (1 - np.abs(facing[some])) ** 3))[:, None]
        lit[some] += shine * (0.8 * self._sky(mirrored) - lit[some])
        haze = (1 - np.exp(-depth / _HAZE))[:, None]
        out[rows] = lit + haze * (np.asarray(self.light.horizon, np.float32) - lit)
        return out.reshape(*rays.shape)

    def _colours(
        self,
        hits: Hits,
        pixels: NDArray[np.intp],
        points: F32,
        normals: F32,
        footprint: F32,
        traffic: Scene | None,
    ) -> tuple[F32, F32]:
        """Reflectances (n, 3) of the numbered ``pixels`` and how much is mirrored (n,)."""
        labels = hits.labels.ravel()[pixels]
        moving = hits.moving.ravel()[pixels]
        paint = np.zeros(len(pixels), np.float32)
        road = np.flatnonzero((labels == ROAD) & ~moving)
        if len(road):
            paint[road] = markings(self._plan, points[road], footprint[road])
        triangle = hits.triangle.ravel()[pixels]
        seen = Pixels(points, normals, triangle, labels, footprint, paint)
        colour = np.zeros((len(pixels), 3), np.float32)
        gloss = np.zeros(len(pixels), np.float32)
        groups: list[tuple[NDArray[np.bool_], Surfaces]] = [(~moving, self._surfaces)]
        if traffic is not None and moving.any():
            groups.append((moving, surfaces(traffic.world, moving=True)))
        for mask, known in groups:
            spots = seen.take(mask).spots(known)
            colour[mask], gloss[mask] = colours(spots, self.condition.season)
        return colour, gloss

    def _lit(self, points: F32, normals: F32, traffic: Scene | None) -> F32:
        """Light (n, 3) that falls on points with normals towards the camera."""
        light = self.light
        up = (0.5 + 0.5 * normals[:, 2:3]).astype(np.float32)
        ambient = 0.75 * (
            up * np.asarray(light.zenith, np.float32)
            + (1 - up) * 0.35 * np.asarray(light.horizon, np.float32)
        )
        if not any(light.sun):
            return np.asarray(ambient * 1.25, np.float32)
        sun = np.maximum(normals @ light.direction, 0)
        lit = np.flatnonzero(sun > 0)
        origins = points[lit] + normals[lit] * np.float32(0.02)
        toward = np.broadcast_to(light.direction, origins.shape)
        free = ~np.isfinite(self.scene.cast(origins, toward)[0])
        if traffic is not None:
            free &= ~np.isfinite(traffic.cast(origins, toward)[0])
        sun[lit] *= free
        return np.asarray(ambient + sun[:, None] * np.asarray(light.sun, np.float32), np.float32)

    def _sky(self, direction: F32) -> F32:
        """Colour (n, 3) of the sky in world directions (n, 3) of any length."""
        d = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        high = np.clip(d[:, 2:3], 0, 1) ** 0.6
        sky = high * np.asarray(self.light.zenith, np.float32) + (1 - high) * np.asarray(
            self.light.horizon, np.float32
        )
        white = 0.35 if self.condition.daytime == "overcast" else 0.9
        # clouds are a plane overhead
        flat = d / np.maximum(d[:, 2:3], 0.04) * np.array([1, 1, 0], np.float32)
        wisps = octaves(
            flat,
            0.02 / np.maximum(d[:, 2], 0.04),
            Octaves(1.8, 5, 0.55),
            211 + 31 * self.condition.number,
        )
        cover = white * np.clip(0.9 * wisps - 0.1, 0, 1)[:, None]
        tone = (
            np.float32(0.6)
            if self.condition.daytime == "overcast"
            else np.asarray(self.light.horizon, np.float32) * np.float32(1.15)
        )
        return np.asarray(sky + cover * (tone - sky), np.float32)


def expose(linear: F32, rng: np.random.Generator) -> U8:
    """The picture (h, w, 3) uint8 that a camera takes of linear colours: exposure by the mean, lens
    blur, noise, gamma.
    """
    grey = linear.mean(axis=2)
    gain = 0.20 / max(float(np.exp(np.mean(np.log(np.maximum(grey, 0.01))))), 0.02)
    exposed = cv2.GaussianBlur(linear * np.float32(np.clip(gain, 0.3, 6.0)), (0, 0), _BLUR)
    exposed = exposed / (1 + 0.25 * exposed) * 1.25  # highlights roll off
    shown = 255 * np.clip(exposed, 0, 1) ** np.float32(1 / 2.2)
    shown += np.float32(_NOISE) * rng.standard_normal(shown.shape, np.float32)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)
