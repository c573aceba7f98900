"""How right the embedding is: first pictures of scenes, pictures along rescues, and what that says in a summary."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from lunar_rescue import sample_scene
from lunar_rescue.arrays import Floats
from lunar_rescue.observation import SLICES
from lunar_rescue.scenes.postures import all_postures
from lunar_rescue.scenes.rocks import MAX_ROCKS
from reproduce.learning.policy import Policy, begin_episode
from reproduce.perception.estimator import EstimatedEnv
from reproduce.perception.frames import rocks_in_view, rotation_of

SAME_ROCK = 0.10  # m, a rock that was found is a real one when it is this near to it
#: Shares of the suit that the robot's arms hide, from and to; the last one has its upper edge.
OCCLUSION = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)


def errors(estimate: Floats, truth: Floats) -> dict[str, float]:
    """Return how far an estimated flat observation (SIZE,) is from the true one: body, key points, targets, ground."""
    body, own = (v[SLICES["P_P"]].astype(np.float64) for v in (estimate, truth))
    turn = rotation_of(estimate) @ rotation_of(truth).T
    skeleton = np.linalg.norm((body - own)[15:].reshape(-1, 3), axis=1)
    targets = (estimate - truth)[SLICES["P_G"]][:6].reshape(2, 3)
    return {
        "centre_cm": 100 * float(np.linalg.norm((body - own)[:3])),
        "attitude_deg": float(np.degrees(Rotation.from_matrix(turn).magnitude())),
        "keypoints_cm": 100 * float(skeleton.mean()),
        "targets_cm": 100 * float(np.linalg.norm(targets, axis=1).max()),
        "velocity_cm_s": 100 * float(np.linalg.norm((body - own)[9:12])),
        "ground_cm": 10 * float(np.abs((estimate - truth)[SLICES["P_T"]][3:]).mean()),
    }


def rocks_found(estimate: Floats, truth: Floats, in_view: Any) -> dict[str, int]:
    """Count rocks in view, those of them that were found, what was taken for a rock, and what of it is one.

    ``in_view`` (MAX_ROCKS,) says which of the true rocks are.
    """
    said, real = (v[SLICES["P_E"]].reshape(MAX_ROCKS, 5) for v in (estimate, truth))
    said, there = said[said[:, 4] > 0], real[:, 4] > 0
    near = cdist(said[:, :2], real[:, :2]) < SAME_ROCK
    near[:, ~there] = False
    return {
        "in_view": int(in_view.sum()),
        "found": int((near.any(axis=0) & in_view).sum()),
        "said": len(said),
        "real": int(near.any(axis=1).sum()),
    }


def first_picture(env: EstimatedEnv, seed: int) -> dict[str, Any]:
    """Return the row of a scene's first picture."""
    scene = sample_scene(seed)
    estimate, _ = env.reset_flat(options={"scene": scene})
    belief = env.estimator.belief
    return {
        "seed": seed,
        "posture": scene.posture,
        "attitude": all_postures()[scene.posture].attitude,
        "task": scene.task,
        "terrain": scene.terrain.kind,
        "recognised": env.estimator.posture.name,
        "probability": float(np.exp(belief.max()) / np.exp(belief).sum()),
        "hidden": env.head.hidden(env.episode),
        **errors(estimate, env.truth),
        **rocks_found(estimate, env.truth, rocks_in_view(env)),
    }


def rescue_pictures(env: EstimatedEnv, policy: Policy, seed: int) -> list[dict[str, Any]]:
    """Act out a rescue on estimates and return a row a picture."""
    scene, done, rows = sample_scene(seed), False, []
    observation = begin_episode(env, policy, scene)
    while not done:
        right, hidden = env.estimator.posture.name == scene.posture, env.head.hidden(env.episode)
        place = {"seed": seed, "step": env.episode.steps, "hidden": hidden, "right": right}
        doubt = 100 * 0.4 * float(np.exp(0.5 * env.estimator.seen.spread[0, 0].item()))
        process = {"process": env.episode.process, "said_cm": doubt}
        rows.append({**place, **process, **errors(observation, env.truth)})
        action = policy.act(observation[None], np.array([env.episode.steps == 0]))[0]
        observation, _, terminated, truncated, info = env.step_flat(action)
        done = terminated or truncated
    return [{**row, "success": info["is_success"]} for row in rows]


def summarise_first(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the rows of first pictures say: share of right postures, medians of errors, precision and recall."""
    counts = rows[["in_view", "found", "said", "real"]].sum()
    wrong = rows[rows["posture"] != rows["recognised"]]
    pairs = (wrong["posture"] + " as " + wrong["recognised"]).value_counts()
    return {
        "pictures": len(rows),
        "posture_right": float((rows["posture"] == rows["recognised"]).mean()),
        **{f"{name}_median": float(rows[name].median()) for name in ERRORS},
        **{f"{name}_p90": float(rows[name].quantile(0.9)) for name in ERRORS},
        "rocks_in_view": int(counts["in_view"]),
        "rock_recall": float(counts["found"] / max(counts["in_view"], 1)),
        "rock_precision": float(counts["real"] / max(counts["said"], 1)),
        "confused": {str(pair): int(number) for pair, number in pairs.items()},
        "by_occlusion": by_occlusion(rows.assign(right=rows["posture"] == rows["recognised"])),
    }


def by_occlusion(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return pictures, share of right postures and medians of errors by the share of the suit that is hidden."""
    band = pd.cut(rows["hidden"], list(OCCLUSION), include_lowest=True, labels=False)
    return [
        {
            "hidden_from": OCCLUSION[int(index)],
            "hidden_to": OCCLUSION[int(index) + 1],
            "pictures": len(group),
            "posture_right": float(group["right"].mean()),
            **{name: float(group[name].median()) for name in ERRORS},
        }
        for index, group in rows.groupby(band)
    ]


def summarise_rescues(rows: pd.DataFrame) -> dict[str, Any]:
    """Return medians of errors along rescues and the noise that ``disturbances`` would call the same, for an axis."""
    axis = 1 / np.sqrt(3)
    return {
        "pictures": len(rows),
        "rescues": rows["seed"].nunique(),
        "successes": int(rows.groupby("seed")["success"].first().sum()),
        "posture_right": float(rows["right"].mean()),
        **{f"{name}_median": float(rows[name].median()) for name in ERRORS},
        "position_deviation": 0.01 * axis * _root(rows["centre_cm"]),
        "attitude_deviation": float(np.radians(axis * _root(rows["attitude_deg"]))),
        "by_occlusion": by_occlusion(rows),
    }


def _root(values: pd.Series) -> float:
    """Return the root of the mean square, of values up to their 99th percentile: a lost body is no noise."""
    kept = values[values <= values.quantile(0.99)]
    return float(np.sqrt((kept**2).mean()))


def noise(summary: Mapping[str, Any]) -> dict[str, float]:
    """Return the deviations of place [m] and attitude [rad] of an evaluation, as ``Disturbance`` takes them."""
    along = summary["along_rescues"]
    return {"position": along["position_deviation"], "attitude": along["attitude_deviation"]}


ERRORS = ("centre_cm", "attitude_deg", "keypoints_cm", "targets_cm")
