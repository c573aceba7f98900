"""What touches what in an episode, and how near the arms are to the rocks."""

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.episode import Episode
from lunar_rescue.physics.robot import Robot
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, Simulation
from lunar_rescue.physics.solver import CONTROL_STEP
from lunar_rescue.tasks import SMALLEST_ERROR, TARGET_RADIUS, Contacts

Array = NDArray[np.float64]

RAY = np.array([0.0, 0.0, 1.5])  # m, straight up from a plate, to see whether the body is above it
PLATE_TOP = np.array([0.0, 0.0, 0.03])  # m, where the rays begin
PLATE_POINTS = (0.0, -0.10, 0.10)  # m from the arm's end along the plate; there may be a gap between the legs
REACH_OF_LINK = 0.60  # m, no part of a link lies further than this from the nearest joint point; contact needs it
SMALLEST_CLEARANCE = 1e-9  # m, keeps the AAPF's distances positive


def mark_distances(episode: Episode) -> Array:
    """Return the distances of every joint to every mark point, (12, m) [m]."""
    between = episode.robot.points[:, None, :] - episode.marks[None, :, :]
    return np.sqrt(np.einsum("ijk,ijk->ij", between, between)) + SMALLEST_CLEARANCE


def touches_rock(simulation: Simulation, robot: Robot, episode: Episode, clearance: Array) -> bool:
    """Tell whether the robot touches a rock; only rocks with a joint near them are asked about.

    Args:
        simulation: Where the bodies are.
        robot: The robot.
        episode: For its rocks.
        clearance: What ``mark_distances`` returned (12, m) [m].
    """
    if not episode.rocks or clearance.min() > REACH_OF_LINK:
        return False
    near = clearance.min(axis=0).reshape(len(episode.rocks), -1).min(axis=1) < REACH_OF_LINK
    return any(simulation.touching(robot.handle, episode.rocks[i]) for i in np.flatnonzero(near))


def both_arms_under(simulation: Simulation, episode: Episode, distance: Array) -> bool:
    """Tell whether process 1 is completed: both ends in their target areas, with the astronaut above them.

    Args:
        simulation: Where the bodies are.
        episode: The episode under way.
        distance: What ``Episode.distances`` returned (2,) [m].
    """
    if episode.rock_contact or distance.max() > TARGET_RADIUS + SMALLEST_ERROR:
        return False

    def under(end: Array, direction: Array) -> bool:
        """Tell whether the body is straight above some point along the plate."""
        points = (end + along * direction + PLATE_TOP for along in PLATE_POINTS)
        return any(simulation.ray_hits(point, point + RAY, episode.astronaut.handle) for point in points)

    return all(map(under, episode.robot.ends, episode.robot.directions))


def hold(simulation: Simulation, robot: Robot, episode: Episode) -> Array:
    """Let a control step pass and return the force of each arm on the astronaut, its mean over the step, (2, 3) [N].

    Contacts are read after each substep, near ones too, which also says from where on the solver has to be fine. Means,
    as a stiff contact's peaks tell of the solver and not of the rescue.
    """
    close = episode.process == 2 or bool(episode.recent[-1].min() < simulation.settings.near)
    # Here and not after the last step's end, as Bullet divides impulses by the present substep where torques are read.
    simulation.solve_finely(close or episode.touched)
    handle, impulses, left = episode.astronaut.handle, [[0.0] * 3, [0.0] * 3], CONTROL_STEP
    while left > 1e-9:
        simulation.advance(1)
        left -= simulation.pace.substep
        rows = simulation.contact_forces(handle, robot.handle)
        for _, link, force in rows:
            for impulse, links in zip(impulses, robot.arm_links, strict=True):
                if link in links:
                    impulse[:] = [a + simulation.pace.substep * b for a, b in zip(impulse, force, strict=True)]
        episode.touched = bool(rows)
        if rows and left > 1e-9:  # back to coarse substeps with a control step only, which holds a whole number of them
            simulation.solve_finely(True)
    return np.array(impulses) / CONTROL_STEP


def body_contacts(simulation: Simulation, episode: Episode) -> Contacts:
    """Return what bears the astronaut: ground, a rock, and the share of the weight that each arm bore in this step."""
    handle, scene = episode.astronaut.handle, episode.scene
    shares = episode.forces @ scene.terrain.up() / (scene.mass * LUNAR_GRAVITY)
    return Contacts(
        ground=simulation.touching_ground(handle),
        rock=any(simulation.touching(handle, rock) for rock in episode.rocks),
        shares=(float(shares[0]), float(shares[1])),
    )
