"""Distances of an arm to itself, to the table, to keep-outs and to another arm.

Every link is the convex hull of its collision shapes. The pairs to check are found once, by
sampling the joint space, and downhill from the nearest samples: links that are always near are
neighbours by construction, pairs that never come near need no check, and a distance that no joint
changes cannot be kept. Where the arm
happens to stand takes no pair away.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vla_zenoh.errors import ProfileError, ResourceError, nearest
from vla_zenoh.kinematics.description import Description
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import rotation_from_rpy
from vla_zenoh.profile import KeepOut, PartBase
from vla_zenoh.types import FloatArray, HeldBox

SAMPLES = 1000
NEVER_SPARE_M = 0.03
"""A pair may come nearer than in any of the samples by this much."""
STARTS, DOWNHILL = 8, 15
"""Samples from which a pair that is not near in any of them is moved nearer, in so many steps."""
DOWNHILL_RAD = 0.4
"""Longest of these steps; it is as long as the distance needs if its slope stays the same."""
NEIGHBOURS_M, NEIGHBOURS_SHARE = 0.03, 0.03
"""Links that are never further apart are neighbours: they touch at a joint. Where other links are
between them, not by more than this share of the arm's length either: in an arm of 15 cm two links
that can touch are never 30 mm apart."""
CONSTANT_M = 1e-3
"""A distance that varies by less over the joint space depends on no joint."""
THINNEST_M = 1e-5
"""A flatter hull ends the process: Qhull finds no first simplex, and Coal does not ask it."""
TABLE = "table"
HELD = "the held object"
FLAT = 1e-6
"""m/rad: a distance with a smaller slope is at its minimum."""
POINT_M = 1e-4
FREE_M = 10.0
"""Distance of a held object while there is none."""
KEPT = 8
"""Configurations of an arm whose placements are kept: each is compared with several others."""


class CollisionPair(NamedTuple):
    """Two things that must not touch.

    Args:
        first: a link, or the held object.
        second: another link, ``table``, or the name of a keep-out.
        limit: ``self_collision``, ``table_distance`` or ``keep_out``.
        is_hand: `first` moves with the TCP.
    """

    first: str
    second: str
    limit: str
    is_hand: bool

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class CollisionModel:
    """Distances between the links of an arm, to the table, and to keep-outs.

    Args:
        kinematics: of the arm; its other joints are locked.
        near_m: distances above this are ignored.
        table_z_m: height of the table in the base frame; None: no table.
        home_rad: (n,) a configuration that counts as a sample: what is near there is checked.
        keep_out: name -> shape in the base frame. Checked for every link that moves, whatever the
            samples.
        may_touch: pairs of links, or of a link and the table, that are not checked.

    Attributes:
        pairs: those that are checked.
        farthest_m: (len(pairs),) greatest distance of each in the samples, inf where not sampled.

    Raises:
        ResourceError: the URDF's collision shapes cannot be loaded, or there are none.
        ProfileError: `may_touch` names a link that is not there.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        *,
        near_m: float,
        table_z_m: float | None = None,
        home_rad: FloatArray | None = None,
        keep_out: Mapping[str, KeepOut] | None = None,
        may_touch: Iterable[tuple[str, str]] = (),
    ) -> None:
        self._model, self._data = kinematics.model, kinematics.model.createData()
        self._hand_joint: int = self._model.frames[kinematics.tcp].parentJoint
        self.held: HeldBox | None = None
        """What the gripper holds, see `hold`."""
        self._held_pairs: list[tuple[int, int]] = []
        self._geometry: Any = _one_hull_a_link(kinematics)
        self._links: int = self._geometry.ngeoms
        if table_z_m is not None:
            at = kinematics.base_placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, table_z_m]))
            half_space = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
            self._geometry.addGeometryObject(pin.GeometryObject(TABLE, 0, 0, at, half_space))
        shapes = self._geometry.geometryObjects
        pairs = [
            (first, second)
            for first, second in itertools.combinations(range(len(shapes)), 2)
            if shapes[first].parentJoint != shapes[second].parentJoint
        ]
        random = np.random.default_rng(0)  # the same pairs at every start
        samples_rad = random.uniform(*kinematics.sampled_rad, (SAMPLES, kinematics.size))
        if home_rad is not None:
            samples_rad = np.vstack([samples_rad, home_rad])
        distances = self._at(samples_rad, pairs)
        nearest_m, farthest_m = distances.min(axis=0), distances.max(axis=0)
        to_links = np.array([second < self._links for _, second in pairs], bool)
        neighbours = to_links & (farthest_m <= self._neighbours_m(pairs, kinematics))
        constant = farthest_m - nearest_m < CONSTANT_M
        allowed = _allowed([shape.name for shape in shapes], may_touch)
        told = np.array([{shapes[a].name, shapes[b].name} in allowed for a, b in pairs], bool)
        varied = ~(neighbours | constant | told)
        wanted = (nearest_m < near_m + NEVER_SPARE_M) & varied
        for index in np.flatnonzero(varied & ~wanted):
            starts_rad = samples_rad[np.argsort(distances[:, index])[:STARTS]]
            wanted[index] = self._comes_near(pairs[index], starts_rad, near_m, kinematics)
        used = [pair for pair, keep in zip(pairs, wanted, strict=True) if keep]
        apart: list[tuple[int, int]] = []
        for name, shape in (keep_out or {}).items():
            added = self._geometry.addGeometryObject(_keep_out(kinematics, name, shape))
            apart += [(link, added) for link in range(self._links) if shapes[link].parentJoint]
        self._pairs, self._held_pairs = [*used, *apart], self._add_held(kinematics)
        self._use(self._pairs)
        self.pairs = tuple(self._pair(*pair) for pair in [*self._pairs, *self._held_pairs])
        self.farthest_m = np.full(len(self.pairs), np.inf)
        self.farthest_m[: len(used)] = farthest_m[wanted]

    def _neighbours_m(self, pairs: Sequence[tuple[int, int]], kinematics: Kinematics) -> FloatArray:
        """(len(pairs),) `NEIGHBOURS_M` of two links, which may have others between them."""
        joints = [int(shape.parentJoint) for shape in self._geometry.geometryObjects]
        parents = [int(parent) for parent in self._model.parents]
        apart_m = min(NEIGHBOURS_M, NEIGHBOURS_SHARE * kinematics.length_m)
        joined = [
            parents[joints[a]] == joints[b] or parents[joints[b]] == joints[a] for a, b in pairs
        ]
        return np.where(joined, NEIGHBOURS_M, apart_m)

    def tcp_beyond_m(self, kinematics: Kinematics) -> float:
        """Distance of the TCP from the shapes that move with it, inf without any."""
        frame = self._model.frames[kinematics.tcp]
        nearest_m = np.inf
        for shape in list(self._geometry.geometryObjects)[: self._links]:
            if shape.parentJoint == frame.parentJoint:
                nearest_m = min(nearest_m, _distance_m(shape, frame.placement))
        return float(nearest_m)

    def reaches_m(self) -> Iterator[tuple[str, float]]:
        """Each link that moves, and how far from its joint its hull ends."""
        for shape in list(self._geometry.geometryObjects)[: self._links]:
            if shape.parentJoint:
                points = np.array(shape.geometry.points()) @ shape.placement.rotation.T
                ends_m = np.linalg.norm(points + shape.placement.translation, axis=1)
                yield shape.name, float(ends_m.max())

    def links(self) -> Any:
        """A geometry model of the arm's links alone, a hull each."""
        alone = pin.GeometryModel()
        shapes = list(self._geometry.geometryObjects)
        for shape in shapes[: self._links] + (shapes[-1:] if self.held else []):
            alone.addGeometryObject(shape)
        return alone

    def hold(self, box: HeldBox | None) -> None:
        """Count `box` among the arm's links, at its TCP; None: the gripper holds nothing."""
        self.held = box
        if box is not None:
            shape = self._geometry.geometryObjects[self._geometry.ngeoms - 1]
            shape.geometry = coal.Box(np.array(box.size_m))
            shape.placement = self._tcp * pin.SE3(np.eye(3), np.array(box.centre_m))
        self._use([*self._pairs, *(self._held_pairs if box else ())])

    def distances(self, joints_rad: FloatArray) -> FloatArray:
        """(len(pairs),) m, negative where two things are inside each other.

        `FREE_M` for pairs of the held object while there is none.
        """
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._work, joints_rad
        )
        pin.computeDistances(self._geometry, self._work)
        found = [result.min_distance for result in self._results]
        if self.held is None:
            found += [FREE_M] * len(self._held_pairs)
        return np.array(found)

    def gradients(self, joints_rad: FloatArray, indices: Sequence[int]) -> FloatArray:
        """(len(indices), n) m/rad: how these distances change with each joint.

        Only after `distances` of the same joints. Undefined for two that are inside each other.
        """
        if not len(indices):
            return np.zeros((0, len(joints_rad)))
        pin.computeJointJacobians(self._model, self._data, joints_rad)
        found = np.zeros((len(indices), len(joints_rad)))
        for row, index in enumerate(indices):
            result, pair = self._results[index], self._geometry.collisionPairs[int(index)]
            normal = np.array(result.normal)
            for sign, which, point in (
                (-1.0, pair.first, result.getNearestPoint1()),
                (1.0, pair.second, result.getNearestPoint2()),
            ):
                joint = self._geometry.geometryObjects[which].parentJoint
                if joint == 0:
                    continue
                jacobian = pin.getJointJacobian(
                    self._model, self._data, joint, pin.LOCAL_WORLD_ALIGNED
                )
                arm_m = np.array(point) - self._data.oMi[joint].translation
                found[row] += sign * (normal @ (jacobian[:3] - pin.skew(arm_m) @ jacobian[3:]))
        return found

    def _pair(self, first: int, second: int) -> CollisionPair:
        link, other = (self._geometry.geometryObjects[index] for index in (first, second))
        limit = "self_collision"
        if other.parentJoint == 0 and second >= self._links:
            limit = "table_distance" if other.name == TABLE else "keep_out"
        is_hand = link.parentJoint == self._hand_joint
        return CollisionPair(link.name, other.name, limit, is_hand)

    def _add_held(self, kinematics: Kinematics) -> list[tuple[int, int]]:
        """Add a box that is not there yet; its pairs with all but the links of the wrist.

        Those of the last two joints may touch what the gripper holds.
        """
        joint, self._tcp = self._hand_joint, self._model.frames[kinematics.tcp].placement
        wrist = (joint, self._model.parents[joint] or joint)
        shapes = self._geometry.geometryObjects
        others = [index for index in range(len(shapes)) if shapes[index].parentJoint not in wrist]
        box = pin.GeometryObject(HELD, joint, 0, self._tcp, coal.Box(np.full(3, 1e-3)))
        added = self._geometry.addGeometryObject(box)
        return [(added, other) for other in others]

    def _comes_near(
        self,
        pair: tuple[int, int],
        starts_rad: FloatArray,
        near_m: float,
        kinematics: Kinematics,
    ) -> bool:
        """Whether two get nearer than `near_m` downhill from some of these configurations."""
        self._use([pair])
        lower, upper = kinematics.lower_rad, kinematics.upper_rad
        for start_rad in starts_rad:
            joints_rad = start_rad
            for _ in range(DOWNHILL):
                distance_m = float(self.distances(joints_rad)[0])
                if distance_m < near_m:
                    return True
                slope = self.gradients(joints_rad, [0])[0]
                slope[(joints_rad <= lower) & (slope > 0)] = 0.0
                slope[(joints_rad >= upper) & (slope < 0)] = 0.0
                steep = float(np.linalg.norm(slope))
                if steep < FLAT:
                    break
                step_rad = min(distance_m / steep, DOWNHILL_RAD) / steep
                joints_rad = np.clip(joints_rad - step_rad * slope, lower, upper)
        return False

    def _use(self, pairs: Sequence[tuple[int, int]]) -> None:
        self._geometry.removeAllCollisionPairs()
        for first, second in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._work = self._geometry.createData()
        for request in self._work.distanceRequests:
            # The last separating direction: the next configuration is a small step away.
            request.gjk_initial_guess = coal.GJKInitialGuess.CachedGuess
        self._results: list[Any] = list(self._work.distanceResults)

    def _at(
        self, configurations: Iterable[FloatArray], pairs: Sequence[tuple[int, int]]
    ) -> FloatArray:
        self._use(pairs)
        return np.array([self.distances(joints_rad) for joints_rad in configurations])


def _allowed(known: Sequence[str], may_touch: Iterable[tuple[str, str]]) -> list[set[str]]:
    """The pairs of `may_touch`, if their names are known."""
    place = ("limits", "reach", "may_touch")
    for pair in may_touch:
        for name in pair:
            if name not in known:
                raise ProfileError(
                    f"there is no {name!r} with a collision shape{nearest(name, known)} "
                    f"Known: {', '.join(known)}",
                    place,
                )
        if len(set(pair)) < len(pair):
            raise ProfileError(f"{pair[0]!r} touches itself: name two links", place)
    return [set(pair) for pair in may_touch]


def collision_shapes(model: Any, urdf: Path) -> Any:
    """The collision shapes of a URDF, whose `model` of all joints is given, as Pinocchio's.

    Raises:
        ResourceError: they cannot be loaded, or there are none.
    """
    # package://name/... is looked for beside the URDF and in every folder above it.
    folders = urdf.resolve().parents
    try:
        geometry = pin.buildGeomFromUrdf(
            model,
            str(urdf),
            pin.GeometryType.COLLISION,
            package_dirs=[str(folder) for folder in folders],
        )
    except (ValueError, RuntimeError) as error:
        raise ResourceError(
            f"the collision shapes of {urdf.name} cannot be loaded: "
            f"{_bad_mesh(Description(urdf), folders)}. package://NAME/... is looked for as "
            "NAME/... beside the URDF and in every folder above it"
        ) from error
    if geometry.ngeoms == 0:
        raise ResourceError(f"{urdf.name} has no collision shapes; give it some, or do without")
    return geometry


def _one_hull_a_link(kinematics: Kinematics) -> Any:
    full = kinematics.full_model
    geometry = collision_shapes(full, kinematics.urdf)
    corners: dict[str, list[FloatArray]] = {}
    for shape in geometry.geometryObjects:
        corners.setdefault(full.frames[shape.parentFrame].name, []).append(_corners(shape))
    hulls = pin.GeometryModel()
    for link, found in corners.items():
        all_m = np.concatenate(found)
        if _thickness_m(all_m) < THINNEST_M:
            raise ResourceError(
                f"link {link!r} of {kinematics.urdf.name} has a flat collision shape: give it a "
                "thickness, or a box in its place"
            )
        points = coal.StdVec_Vec3s()
        points.extend([corner.copy() for corner in all_m])
        hull = coal.Convex.convexHull(points, True, "Qt")
        frame = full.getFrameId(link, pin.FrameType.BODY)
        parent = full.frames[frame].parentJoint
        hulls.addGeometryObject(pin.GeometryObject(link, parent, frame, pin.SE3.Identity(), hull))
    _, reduced = pin.buildReducedModel(
        full, hulls, kinematics.locked_joints, kinematics.locked_position
    )
    return reduced


def _thickness_m(points_m: FloatArray) -> float:
    """Of the slab that holds points (m, 3), about across the direction in which they vary least."""
    apart_m = points_m - points_m.mean(axis=0)
    across = np.linalg.eigh(apart_m.T @ apart_m)[1][:, 0]
    return float(np.ptp(apart_m @ across))


def _distance_m(shape: Any, place: Any) -> float:
    """Distance of a point from a shape, both placed in the same joint's frame."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    at = coal.Transform3s(shape.placement.rotation, shape.placement.translation)
    point = coal.Transform3s(np.eye(3), place.translation)
    return coal.distance(shape.geometry, at, coal.Sphere(POINT_M), point, request, result) + POINT_M


def _corners(shape: Any) -> FloatArray:
    """(m, 3) points whose hull holds the shape, in its joint's frame."""
    geometry, placement = shape.geometry, shape.placement
    sides = 24
    turn = np.arange(sides) * 2 * np.pi / sides
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1) / np.cos(np.pi / sides)
    if isinstance(geometry, coal.BVHModelBase):
        points = np.array(geometry.vertices())
    elif isinstance(geometry, coal.Box):
        points = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * geometry.halfSide
    elif isinstance(geometry, coal.Cylinder):
        heights = np.array([-geometry.halfLength, geometry.halfLength])
        points = _prism(around * geometry.radius, heights)
    elif isinstance(geometry, (coal.Sphere, coal.Capsule)):
        half = geometry.halfLength if isinstance(geometry, coal.Capsule) else 0.0
        tilt = np.linspace(-0.5, 0.5, 9) * np.pi
        rings = [
            _prism(around * (geometry.radius * np.cos(t)), np.array([geometry.radius * np.sin(t)]))
            for t in tilt
        ]
        ball = np.concatenate(rings) / np.cos(np.pi / 16)
        points = np.concatenate([ball + (0, 0, half), ball - (0, 0, half)])
    else:
        raise ResourceError(
            f"a collision shape of the kind {type(geometry).__name__} is not known; "
            "known: mesh, box, cylinder, sphere, capsule"
        )
    return points @ placement.rotation.T + placement.translation


def _prism(ring: FloatArray, heights: FloatArray) -> FloatArray:
    return np.concatenate(
        [np.concatenate([ring, np.full((len(ring), 1), height)], axis=1) for height in heights]
    )


def _keep_out(kinematics: Kinematics, name: str, shape: KeepOut) -> Any:
    turn = np.eye(3)
    if shape.box_m is not None:
        solid = coal.Box(np.array(shape.box_m))
        turn = rotation_from_rpy(np.array([0.0, 0.0, shape.yaw_rad]))
    elif shape.radius_m is not None:
        solid = coal.Sphere(shape.radius_m)
    else:
        normal = np.array(shape.normal)
        solid = coal.Halfspace(normal / np.linalg.norm(normal), 0.0)
    placement = kinematics.base_placement * pin.SE3(turn, np.array(shape.centre_m))
    return pin.GeometryObject(name, 0, 0, placement, solid)


class Nearest(NamedTuple):
    """The two links of two arms that are nearest to each other; negative: inside each other.

    The links are empty if nothing is nearer than was looked for.
    """

    distance_m: float
    first: str = ""
    second: str = ""

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class Placement(NamedTuple):
    """Of the hulls of an arm: transforms into the robot's frame, (m, 3) centres of spheres."""

    transforms: list[Any]
    centres_m: FloatArray


class PlacedArm:
    """The hulls of an arm's links, placed in the frame of the robot.

    Args:
        kinematics: of the arm.
        collisions: has a hull for each link.
        base: where its base frame stands.
    """

    def __init__(self, kinematics: Kinematics, collisions: CollisionModel, base: PartBase) -> None:
        self._model = kinematics.model.copy()
        turn = rotation_from_rpy(np.array([0.0, 0.0, base.yaw_rad]))
        stands = pin.SE3(turn, np.array(base.position_m)) * kinematics.base_placement.inverse()
        self._geometry: Any = collisions.links()
        for joint, parent in enumerate(self._model.parents):
            if joint > 0 and parent == 0:
                self._model.jointPlacements[joint] = stands * self._model.jointPlacements[joint]
        for shape in self._geometry.geometryObjects:
            if shape.parentJoint == 0:
                shape.placement = stands * shape.placement
        self._data, self._placed = self._model.createData(), self._geometry.createData()
        shapes = list(self._geometry.geometryObjects)
        self._names = [shape.name for shape in shapes]
        self._hulls: list[Any] = [shape.geometry for shape in shapes]
        for hull in self._hulls:
            hull.computeLocalAABB()
        centres = np.array([hull.aabb_center for hull in self._hulls])
        self._centres_m = np.hstack([centres, np.ones((len(centres), 1))])[:, :, None]
        self._radii_m = np.array([hull.aabb_radius for hull in self._hulls])
        self._kept: dict[bytes, Placement] = {}

    def _place(self, joints_rad: FloatArray) -> Placement:
        """Where the hulls are at these joints (n,)."""
        key = joints_rad.tobytes()
        if key not in self._kept:
            pin.updateGeometryPlacements(
                self._model, self._data, self._geometry, self._placed, joints_rad
            )
            frames = list(self._placed.oMg)
            matrices = np.array([frame.homogeneous for frame in frames])
            transforms = [coal.Transform3s(frame.rotation, frame.translation) for frame in frames]
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[key] = Placement(transforms, (matrices @ self._centres_m)[:, :3, 0])
        return self._kept[key]

    def nearest(
        self,
        own_rad: Sequence[FloatArray],
        other: PlacedArm,
        other_rad: Sequence[FloatArray],
        within_m: float,
    ) -> Nearest:
        """The nearest links with this arm and another at any two of these configurations (n,).

        Links further apart than `within_m` are not looked for.
        """
        ones = [self._place(joints_rad) for joints_rad in own_rad]
        others = [other._place(joints_rad) for joints_rad in other_rad]
        one_m = np.array([placed.centres_m for placed in ones])
        other_m = np.array([placed.centres_m for placed in others])
        between_m = one_m[:, None, :, None] - other_m[None, :, None, :]
        spheres_m = self._radii_m[:, None] + other._radii_m[None, :]
        apart_m = np.sqrt((between_m * between_m).sum(axis=-1)) - spheres_m
        found = Nearest(within_m)
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        places = np.argwhere(apart_m < within_m)
        bounds_m = apart_m[apart_m < within_m]
        order = np.argsort(bounds_m)
        for (a, b, i, j), bound_m in zip(
            places[order].tolist(), bounds_m[order].tolist(), strict=True
        ):
            if bound_m >= found.distance_m:
                break
            result.clear()
            distance_m = coal.distance(
                self._hulls[i],
                ones[a].transforms[i],
                other._hulls[j],
                others[b].transforms[j],
                request,
                result,
            )
            if distance_m < found.distance_m:
                found = Nearest(distance_m, self._names[i], other._names[j])
        return found


def _bad_mesh(description: Description, folders: Sequence[Path]) -> str:
    """Which collision mesh cannot be loaded, and why."""
    for link, name in description.meshes:
        whose = f"link {link!r} has the mesh {name!r}, which"
        scheme, colon, rest = name.partition("://")
        if colon and scheme not in ("package", "file"):
            return f"{whose} is no file: give its path, or package://NAME/..."
        places = [Path(rest)] if scheme == "file" else [each / (rest or name) for each in folders]
        found = next((place for place in places if place.exists()), None)
        if found is None:
            return f"{whose} is not there"
        try:
            coal.MeshLoader().load(str(found), np.ones(3))
        except (ValueError, RuntimeError):
            return f"{whose} is no mesh that can be read (STL, DAE, OBJ)"
    return "one of its meshes cannot be read"
