"""DressRing: what an episode is made of, what counts as dressed, and that cheating does not."""

from __future__ import annotations

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import dress_ring, dressing, policies
from clothgym_envs.dress_ring import VARIATIONS, DressRingEnv, cuff
from clothgym_envs.dressing import LimbPath

import clothgym as cg

RING = "clothgym/DressRing-v0"
STILL = np.zeros(3)


@pytest.fixture(scope="module")
def env() -> DressRingEnv:
    return gym.make(RING).unwrapped


def run(env: DressRingEnv, seed: int, act, steps: int = 60) -> list[tuple]:
    """An episode of `act(env, number of the step)`; the answers of its steps."""
    env.reset(seed=seed)
    answers = []
    for number in range(steps):
        answers.append(env.step(np.clip(act(env, number), -1.0, 1.0)))
        if answers[-1][2] or answers[-1][3]:
            break
    return answers


def put(env: DressRingEnv, depth: float, offset: float = 0.0, turned: bool = False) -> np.ndarray:
    """(V, 3) the cuff around the limb with its leading border so far along it [m]."""
    limb, x = env.limb, env.cuff.vertices.copy()
    if turned:
        x[:, :2] = [dress_ring.CUFF_LENGTH, 0.0] - x[:, :2]
    way = (limb.tip - limb.points[0]) / limb.length
    side = np.cross(way, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    frame = np.stack([way, -side, np.cross(way, -side)])
    return limb.at(depth)[0] + x @ frame + offset * side


def hold(env: DressRingEnv, positions: np.ndarray, monkeypatch, steps: int = 6) -> dict:
    """Puts the cuff somewhere and leaves it there; what the last step told."""
    env.simulation.set_positions(positions)
    monkeypatch.setattr(env, "_act", lambda action: None)
    info: dict = {}
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(STILL)
        if terminated or truncated:
            break
    return info


def towards(env: DressRingEnv, place: np.ndarray) -> np.ndarray:
    """The action that brings the leading opening there."""
    return (place - env.openings[0].centroid) / (dress_ring.SPEED * env.control_period)


def areas(made: dress_ring.Cuff) -> np.ndarray:
    """(F,) of the faces in their panels [m^2]."""
    (ax, ay), (bx, by) = (np.moveaxis(made.rest[:, k] - made.rest[:, 0], 1, 0) for k in (1, 2))
    return 0.5 * np.abs(ax * by - ay * bx)


# the scene


@pytest.mark.parametrize(("fidelity", "count"), dress_ring.VERTICES.items())
def test_the_cuff_is_sewn_from_its_pattern(fidelity, count):
    made = cuff(count, 0.5)
    assert abs(len(made.vertices) - count) < 0.1 * count
    assert areas(made).sum() == pytest.approx(0.5 * dress_ring.CUFF_LENGTH)
    assert np.hypot(made.vertices[:, 1], made.vertices[:, 2]) == pytest.approx(0.5 / (2.0 * math.pi))
    for border, place in ((made.leading, 0.0), (made.trailing, dress_ring.CUFF_LENGTH)):
        assert made.vertices[border, 0] == pytest.approx(place)
        assert dressing.measure(made.vertices[border]).normal[0] == pytest.approx(1.0, abs=1e-6)
    placed = made.vertices[made.faces]
    for k in range(3):
        sewn = np.linalg.norm(made.rest[:, k] - made.rest[:, k - 1], axis=1)
        chord = np.linalg.norm(placed[:, k] - placed[:, k - 1], axis=1)
        assert (chord < sewn * 1.001).all()
        assert chord == pytest.approx(sewn, rel=0.04), "nothing but chords instead of arcs"
    assert cg.intersections(made.vertices, made.faces).hit_count == 0


def test_fidelities_differ_in_vertices_and_contact():
    counts = {}
    for fidelity in dress_ring.VERTICES:
        env = gym.make(RING, fidelity=fidelity).unwrapped
        counts[fidelity] = env.simulation.model.vertex_count
        assert env.simulation.scene.self_collision == (fidelity != "draft")
    assert counts["draft"] < counts["balanced"] < counts["accurate"]


@pytest.mark.parametrize("level", ["easy", "medium", "hard"])
def test_every_start_is_free(level):
    env = gym.make(RING, level=level).unwrapped
    seen = []
    for seed in range(25):
        observation, info = env.reset(seed=seed)
        assert (info["threaded"], info["tunnelled"], info["contour_length"], info["progress"]) == (0, False, 0.0, 0.0)
        assert info["penetration_depth"] < 1e-3
        assert info["max_strain"] < 0.3
        assert len(env.simulation.held(0)) >= 5
        assert env.limb.skin_distances(env.gripper_positions)[0] >= dressing.GRIPPER_RADIUS
        for name, (low, high) in dress_ring._LEVELS[level].items():
            assert low <= env.variation[name] <= high
        seen.append(observation)
    assert np.std(seen, axis=0)[:3].min() > 0.1, "starts differ"


@pytest.mark.parametrize("name", VARIATIONS)
def test_each_variation_changes_what_it_names(env, name):
    told = []
    for value in (0.0, 1.0):
        env.reset(seed=3, options={"variation": {name: value}})
        sim, limb = env.simulation, env.limb
        way = limb.tip - limb.points[0]
        told.append(
            {
                "shoulder": way[1],
                "yaw": way[2],
                "radius": limb.radius,
                "ease": np.hypot(*env.cuff.vertices[0, 1:]) / limb.radius,
                "stiffness": sim.model.spring_stiffness[0],
                "mass": sim.model.masses.sum() / areas(env.cuff).sum(),
                "friction": sim.scene.bodies[0].friction,
                "start_x": (env._start - limb.tip)[0],
                "start_y": (env._start - limb.tip)[1],
                "start_z": (env._start - limb.tip)[2],
                "noise": env._noise_size,
                "delay": env._delay,
            }
        )
    expected = {
        "shoulder": (0.55 * -0.5, 0.55 * 0.5),
        "yaw": (0.55 * math.sin(math.radians(-15.0)), 0.55 * math.sin(math.radians(15.0))),
        "radius": (0.036, 0.054),
        "ease": (1.1, 2.0),
        "stiffness": (dress_ring.STRETCH / 3.0, dress_ring.STRETCH * 3.0),
        "mass": (0.1, 0.4),
        "friction": (0.0, 0.6),
        "start_x": (0.05, 0.25),
        "start_z": (-0.1, 0.1),
        "noise": (0.0, 5e-3),
        "delay": (0, 2),
    }
    low, high = (values[name] for values in told)
    if name == "start_y":
        assert high - low == pytest.approx(0.2)
    elif name == "yaw":
        tilt = math.cos(math.radians(60.0 * env.variation["shoulder"] - 30.0))
        assert (low, high) == pytest.approx(tuple(tilt * value for value in expected[name]), rel=1e-6)
    else:
        assert (low, high) == pytest.approx(expected[name], rel=1e-6)
    others = [key for key in told[0] if key not in (name, "start_y", "radius", "ease", "shoulder", "yaw")]
    for key in others:
        assert told[0][key] == pytest.approx(told[1][key]), f"{name} changes {key}"


def test_unknown_variations_are_refused(env):
    for name in ("elbow", "motion"):
        with pytest.raises(ValueError, match=rf"options\['variation'\]\['{name}'\]: unknown; expected shoulder"):
            env.reset(seed=0, options={"variation": {name: 0.5}})
    with pytest.raises(ValueError, match=r"\['ease'\] = -0.1"):
        env.reset(seed=0, options={"variation": {"ease": -0.1}})
    given = {"variation": {"ease": 0.5}}
    env.reset(seed=0, options=given)
    assert given == {"variation": {"ease": 0.5}}


# the gripper


def test_a_gripper_reads_the_weight_it_carries(env):
    answers = run(env, 1, lambda env, number: STILL, 59)
    read = [observation[env.obs_layout["gripper/force"].slice] * 5.0 for observation, *_ in answers[-20:]]
    weight = 9.81 * env.simulation.model.masses.sum()
    mean = np.mean(read, axis=0)
    assert mean[1] == pytest.approx(weight, rel=0.01)
    assert np.abs(mean[[0, 2]]).max() < 0.02 * weight
    assert answers[-1][4]["force_max"] == pytest.approx(weight, rel=0.02)
    assert answers[-1][4]["force_limb"] == 0.0


def test_grippers_cannot_enter_the_limb_nor_reach_its_root(env):
    for aim in (lambda env: env.limb.at(0.1)[0], lambda env: env.limb.points[0]):
        env.reset(seed=2)
        for _ in range(50):
            way = (aim(env) - env.gripper_positions[0]) / (dress_ring.SPEED * env.control_period)
            _, _, terminated, truncated, _ = env.step(np.clip(way, -1.0, 1.0))
            assert env.limb.skin_distances(env.gripper_positions)[0] >= dressing.GRIPPER_RADIUS - 1e-9
            assert env.limb.closest(env.gripper_positions)[1][0] <= env.wanted + 0.05 + 1e-9
            if terminated or truncated:
                break
    for action in np.vstack([np.eye(3), -np.eye(3)]):
        assert run(env, 2, lambda env, number, action=action: action)[-1][4]["failure"] == 0
        low, high = env.limb.tip + dress_ring._WORKSPACE
        assert (env.gripper_positions[0] >= low - 1e-9).all()
        assert (env.gripper_positions[0] <= high + 1e-9).all()


def test_a_delay_keeps_actions_back(env):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 3))
    ways = {}
    for steps in (0, 1, 2):
        env.reset(seed=4, options={"variation": {"delay": steps / 2.0}})
        places = [env.gripper_positions[0].copy()]
        for n, action in enumerate(actions):
            observation = env.step(action)[0]
            places.append(env.gripper_positions[0].copy())
            past = np.zeros((2, 3))
            past[: min(n + 1, 2)] = actions[max(n - 1, 0) : n + 1][::-1]
            assert observation[env.obs_layout["past_actions"].slice] == pytest.approx(past.ravel(), abs=1e-6)
        ways[steps] = np.diff(places, axis=0)
    assert ways[0] == pytest.approx(actions * dress_ring.SPEED * env.control_period)
    assert ways[1] == pytest.approx(np.vstack([np.zeros((1, 3)), ways[0][:-1]]))
    assert ways[2] == pytest.approx(np.vstack([np.zeros((2, 3)), ways[0][:-2]]))


def test_noise_is_on_sensed_places_only(env):
    seen = {}
    for noise in (0.0, 1.0, 1.0):
        env.reset(seed=5, options={"variation": {"noise": noise}})
        told = [env.step(np.array([-0.5, 0.1, 0.2])) for _ in range(20)]
        hashed = env.simulation.state_hash()
        if noise in seen:
            assert (seen[noise][0] == [t[0] for t in told]).all(), "the same again"
        seen[noise] = (np.array([t[0] for t in told]), [t[1] for t in told], hashed)
    assert seen[0.0][1:] == seen[1.0][1:], "rewards and states are true"
    gap = seen[1.0][0] - seen[0.0][0]
    places = np.zeros(gap.shape[1], bool)
    for name in ("gripper/position", "leading/centroid", "trailing/centroid"):
        field = env.obs_layout[name]
        places[field.slice] = True
        assert 2e-3 < (gap[:, field.slice] * field.scale).std() < 8e-3
    assert (gap[:, ~places] == 0.0).all()


def test_named_values_are_true(env):
    run(env, 6, lambda env, number: towards(env, env.limb.at(0.1)[0]), 35)
    observation, _, _, _, info = env.step(np.array([-0.1, 0.1, 0.0]))

    def seen(name: str) -> np.ndarray:
        field = env.obs_layout[name]
        return observation[field.slice].astype(float) * field.scale

    sim, limb = env.simulation, env.limb
    leading = sim.positions[env.cuff.leading]
    assert seen("gripper/position") == pytest.approx(sim.grip_positions[0] - limb.tip, abs=1e-6)
    assert seen("leading/centroid") == pytest.approx(leading.mean(axis=0) - limb.tip, abs=1e-6)
    assert seen("leading/normal") == pytest.approx(dressing.measure(leading).normal, abs=1e-6)
    assert seen("limb/tip") == pytest.approx(limb.tip, abs=1e-6)
    assert seen("limb/start") == pytest.approx(limb.at(env.wanted)[0] - limb.tip, abs=1e-6)
    assert seen("leading/threaded")[0] == info["threaded"] == dressing.threaded(leading, limb)
    assert seen("max_strain")[0] == pytest.approx(cg.metrics.max_strain(sim.model, sim.positions), abs=1e-6)
    assert seen("force_sum")[0] == pytest.approx(np.linalg.norm(sim.body_forces, axis=1).sum(), abs=1e-5)
    assert info["max_strain"] == pytest.approx(seen("max_strain")[0], abs=1e-6)
    assert seen("time_left")[0] == pytest.approx(1.0 - env.steps / env.horizon)


# what counts


def test_a_worn_cuff_is_a_success(env, monkeypatch):
    env.reset(seed=1)
    info = hold(env, put(env, 0.23), monkeypatch, 10)
    assert info["is_success"]
    assert env.steps == dress_ring.HELD_STEPS
    assert (info["progress"], info["threaded"], info["reward/success"]) == (1.0, 1, 5.0)
    assert info["success_unsafe"] is False


def test_what_is_missing_for_success(env, monkeypatch):
    """One thing wrong at a time."""
    env.reset(seed=1)
    good = put(env, 0.23)

    def wrong(positions: np.ndarray) -> dict:
        with monkeypatch.context() as patch:
            env.reset(seed=1)
            info = hold(env, positions, patch)
        assert info["is_success"] is False
        assert info["dressed_steps"] == 0
        return info

    assert wrong(put(env, 0.21))["depth"] < 0.9
    assert wrong(put(env, 0.23, turned=True))["threaded"] == -1
    assert wrong(put(env, -0.15))["threaded"] == 0
    stretched = good.copy()
    stretched[env.cuff.trailing[:1]] += 0.03 * env.limb.closest(env.limb.tip)[2][0] * -1.0
    assert wrong(stretched)["max_strain"] > 0.15
    crossed = good.copy()
    top = np.argsort(env.cuff.vertices[:, 1])[-2:]
    crossed[top, 1] -= 0.3 * env.limb.radius + 2.0 * env.cuff.vertices[:, 1].max()
    assert wrong(crossed)["contour_length"] > 0.0
    inside = good.copy()
    low = int(np.argmin(np.abs(env.cuff.vertices[:, 0] - 0.5 * dress_ring.CUFF_LENGTH)))
    inside[low] = env.limb.closest(good[low])[0][0]
    assert wrong(inside)["penetration_depth"] > 5e-3


def test_penetration_is_that_of_the_true_surface(env):
    for depth in (-0.2, 0.0, 0.2):
        env.reset(seed=1)
        for shift in (0.0, 0.03, 0.06, 0.2):
            env.simulation.set_positions(put(env, depth, shift))
            env._measure()
            assert env._penetration() == env.simulation.penetration_depth()
    assert env._penetration() == 0.0


def test_tunnelled_stays_and_blocks(env, monkeypatch):
    env.reset(seed=1)
    env._tunnelled = True
    before = env.potential
    info = hold(env, put(env, 0.23), monkeypatch, 10)
    assert not info["is_success"]
    assert (info["tunnelled"], info["progress"], info["threaded"]) == (True, 0.0, 1)
    assert env.potential == dressing.WRONG < before


def test_both_borders_are_looked_at_in_every_simulator_step(env, monkeypatch):
    asked = []
    look = dressing.passed_sideways

    def listening(before, after, limb):
        asked.append((before, after))
        return look(before, after, limb)

    monkeypatch.setattr(dressing, "passed_sideways", listening)
    env.reset(seed=1)
    asked.clear()
    start = np.array(env.simulation.positions)
    for _ in range(2):
        env.step(np.array([-1.0, 0.0, 0.0]))
    assert len(asked) == 2 * 3 * 2
    for border, pairs in ((env.cuff.leading, asked[0::2]), (env.cuff.trailing, asked[1::2])):
        assert (pairs[0][0] == start[border]).all()
        for one, two in itertools.pairwise(pairs):
            assert (one[1] == two[0]).all(), "no gap"
        assert (pairs[-1][1] == env.simulation.positions[border]).all()


def test_force_makes_it_unsafe(env, monkeypatch):
    env.reset(seed=1)
    env._peak_force = 20.1
    info = hold(env, put(env, 0.23), monkeypatch, 8)
    assert info["success_unsafe"] is True
    assert info["is_success"] is False
    assert info["progress"] == pytest.approx(0.9 * info["depth"])
    env.reset(seed=1)
    assert env._peak_force == 0.0


def test_peaks_of_force_are_remembered(env):
    run(env, 1, lambda env, number: np.array([-1.0, -1.0, 0.0]), 25)
    assert env._peak_force >= max(env._forces()) > 0.0


# cheats


def sideways(env, number):
    if number < 30:
        return towards(env, env.limb.at(0.15)[0] + np.array([0.0, 0.0, 0.16]))
    return np.array([0.0, 0.0, -1.0])


def from_above(env, number):
    if number < 26:
        return towards(env, env.limb.at(0.15)[0] + np.array([0.0, 0.2, 0.0]))
    return np.array([0.0, -1.0, 0.0])


def from_below(env, number):
    if number < 12:
        return towards(env, env.limb.at(-0.2)[0] - np.array([0.0, 0.25, 0.0]))
    if number < 30:
        return towards(env, env.limb.at(0.15)[0] - np.array([0.0, 0.2, 0.0]))
    return np.array([0.0, 1.0, 0.0])


def shaking(env, number):
    return np.array([-1.0, (-1.0) ** number, (-1.0) ** (number // 2)])


def hammering(env, number):
    return np.full(3, 1.0 if number % 2 else -1.0)


def parking(env, number):
    return towards(env, env.limb.at(-0.05)[0])


def on_the_threshold(env, number):
    return towards(env, env.limb.at(0.01)[0])


def pinching(env, number):
    if number < 20:
        return towards(env, env.limb.tip)
    return np.array([(-1.0) ** (number // 3), -1.0, 0.0])


def around_the_root(env, number):
    if number < 36:
        return np.array([-1.0, 0.3 if number < 10 else 0.0, 0.6 if number < 16 else 0.0])
    return towards(env, env.limb.points[0] - np.array([0.1, 0.0, 0.0]))


CHEATS = (
    sideways, from_above, from_below, shaking, hammering, parking, on_the_threshold, pinching, around_the_root,
)  # fmt: skip


@pytest.mark.parametrize("cheat", CHEATS, ids=lambda cheat: cheat.__name__)
def test_cheats_do_not_pay(env, cheat):
    # not 10_003: at every fidelity the way to beside that limb leads over its tip, and the cuff is on it
    for seed in (10_000, 10_004):
        answers = run(env, seed, cheat)
        assert not any(answer[4]["is_success"] for answer in answers)
        assert answers[-1][4]["progress"] < 0.1
        assert sum(answer[1] for answer in answers) < 3.0


@pytest.fixture(params=["draft", "balanced"])
def ghost(request) -> DressRingEnv:
    """A limb that only rules know: the cuff hangs 17 cm beside it, and the real limb is out of the way."""
    env = gym.make(RING, fidelity=request.param).unwrapped
    env.reset(seed=1, options={"variation": {"shoulder": 0.5, "yaw": 0.5}})
    way = env.limb.tip - env.limb.points[0]
    tip = env.openings[0].centroid + 0.1 * way / env.limb.length + np.array([0.0, 0.0, 0.17])
    env.limb = LimbPath(np.array([tip - way, tip]), env.limb.radius)
    env._measure()
    return env


def test_a_cuff_torn_through_the_limb_never_scores(ghost):
    """The worst case: nothing holds it up. Pulled sideways through the limb, then up to where a worn cuff would be."""
    told = []
    for number in range(50):
        action = towards(ghost, ghost.limb.at(0.1 if number < 25 else 0.26)[0])
        told.append(ghost.step(np.clip(action, -1.0, 1.0)))
    infos = [answer[4] for answer in told]
    assert infos[-1]["threaded"] == 1
    assert infos[-1]["depth"] > 0.95
    assert ghost.worn[1].threaded == 1
    torn = [info["tunnelled"] for info in infos]
    assert torn.index(True) <= [info["threaded"] for info in infos].index(1), "before the number changes"
    assert torn == sorted(torn), "once torn, always torn"
    assert not torn[1], "beside the limb nothing has happened yet"
    assert not any(info["is_success"] for info in infos)
    assert infos[-1]["progress"] == 0.0
    assert sum(answer[1] for answer in told) < -1.0


def test_pulled_through_and_out_again_is_remembered(ghost):
    for number in range(50):
        place = ghost.limb.at(0.1)[0] + np.array([0.0, 0.0, 0.0 if number < 25 else -0.25])
        info = ghost.step(np.clip(towards(ghost, place), -1.0, 1.0))[4]
    assert (info["threaded"], info["tunnelled"]) == (0, True)


def test_over_the_tip_of_the_same_limb_is_fine(ghost):
    front = ghost.limb.at(-0.08)[0] - np.array([0.0, 0.0, 0.17])
    policy, info, terminated = policies.get(RING, "axis"), {}, False
    policy.reset(ghost)
    while np.linalg.norm(front - ghost.openings[0].centroid) > 0.03:
        ghost.step(np.clip(towards(ghost, front), -1.0, 1.0))
    while not terminated and ghost.steps < ghost.horizon:
        _, _, terminated, _, info = ghost.step(policy.act(None, info))
    assert (info["threaded"], info["tunnelled"], info["is_success"]) == (1, False, True)


# wholes


def test_rewards_of_a_good_and_of_a_lazy_episode(env):
    policy = policies.get(RING, "axis")

    def act(env, number):
        if number == 0:
            policy.reset(env)
        return policy.act(None, {})

    good = run(env, 10_000, act)
    lazy = run(env, 10_000, lambda env, number: STILL)
    assert good[-1][2]
    assert good[-1][4]["is_success"]
    assert sum(a[1] for a in good) > 10.0
    assert abs(sum(a[1] for a in lazy)) < 0.5
    assert lazy[-1][3]
    gained = sum(a[4]["reward/potential"] for a in good)
    env.reset(seed=10_000)
    assert gained == pytest.approx(10.0 * (1.0 - env.potential), abs=10.0 * 0.1)


def test_a_state_brings_its_limb_along(env):
    env.reset(seed=1, options={"variation": {"radius": 1.0}})
    env.step(np.array([-1.0, 0.0, 0.0]))
    state, limb, told = env.get_state(), env.limb, env.layout.pack(env._values())
    env.reset(seed=2, options={"variation": {"radius": 0.0}})
    env.set_state(state)
    assert env.limb.radius == limb.radius
    assert (env.limb.points == limb.points).all()
    assert (env.layout.pack(env._values()) == told).all()
