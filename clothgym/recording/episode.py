"""An episode as data: what made it, what was done, and what came out, exact to the last bit.

JSON only. Arrays travel as base64 of their little-endian bytes, so that a replay applies the very same numbers.
"""

from __future__ import annotations

import base64
import binascii
import functools
import hashlib
import json
import math
import platform
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

EPISODE_FORMAT = "clothgym-episode"
EPISODE_VERSION = 1
ACTION_TYPES = ("float32", "float64", "int64")
ARRAY_TYPES = (
    *("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    *("float16", "float32", "float64"),
)
MAX_STEPS = 10_000_000
MAX_JSON = 2_000_000_000
_PACKAGES = ("clothgym", "numpy", "numba", "scipy", "gymnasium", "rerun-sdk")


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode: enough to simulate it again and to compare every step.

    Attributes:
        env_id: the environment's id, such as clothgym/DressSleeve-v0.
        kwargs: JSON keyword arguments of `gymnasium.make` (level, fidelity, obs, ...).
        seed: what reset() was given, or None; episode_seed: the seed that the episode was computed from.
        options: JSON options of reset(), or None.
        actions: (T, A) float32, float64 or int64, exactly as they were given.
        action_shape: shape of one action; () for a discrete one (then A = 1).
        hashes: T + 1 state hashes, the first of them after reset().
        rewards: (T,) float64.
        terminated, truncated: how the last step ended.
        failure: the error that stopped the episode, or "".
        failed_action: (A,) the action during which that error came, or None.
        max_episode_steps: the time limit around the environment, or None.
        fidelity: the fidelity in full, as the environment reported it, or None.
        wrappers: names of the wrappers between recorder and environment.
        obstacles: why the episode cannot be replayed; empty when it can.
        versions: packages, engine and platform that computed it.
    """

    env_id: str
    kwargs: dict[str, Any]
    seed: int | None
    episode_seed: int
    options: dict[str, Any] | None
    actions: NDArray[Any]
    hashes: tuple[str, ...]
    rewards: NDArray[np.float64]
    terminated: bool = False
    truncated: bool = False
    action_shape: tuple[int, ...] | None = None
    failure: str = ""
    failed_action: NDArray[Any] | None = None
    max_episode_steps: int | None = None
    fidelity: Any = None
    wrappers: tuple[str, ...] = ()
    obstacles: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks: list[tuple[str, bool, str]] = [
            ("env_id", _is_text(self.env_id, 200) and bool(self.env_id), "a name of at most 200 letters"),
            ("kwargs", _is_object(self.kwargs), "a JSON object"),
            ("seed", self.seed is None or _is_seed(self.seed), "an integer in [0, 2**63), or null"),
            ("episode_seed", _is_seed(self.episode_seed), "an integer in [0, 2**63)"),
            ("options", self.options is None or _is_object(self.options), "a JSON object, or null"),
            ("hashes", all(_is_text(h, 200) for h in self.hashes), "texts"),
            ("terminated", isinstance(self.terminated, bool), "true or false"),
            ("truncated", isinstance(self.truncated, bool), "true or false"),
            ("failure", _is_text(self.failure, 10_000), "a text"),
            (
                "max_episode_steps",
                self.max_episode_steps is None or _is_seed(self.max_episode_steps),
                "a count, or null",
            ),
            ("fidelity", _is_json(self.fidelity), "JSON"),
            ("wrappers", all(_is_text(w, 200) for w in self.wrappers), "texts"),
            ("obstacles", all(_is_text(o, 1000) for o in self.obstacles), "texts"),
            ("versions", _is_object(self.versions) and all(_is_text(v, 500) for v in self.versions.values()), "texts"),
        ]
        for name, fine, expected in checks:
            if not fine:
                raise ValueError(f"{name} = {str(getattr(self, name))[:80]!r}: expected {expected}")
        count = len(self.actions)
        if self.actions.ndim != 2 or self.actions.dtype.name not in ACTION_TYPES or count > MAX_STEPS:
            raise ValueError(f"actions: {self.actions.dtype} {self.actions.shape}: expected (T, A) of {ACTION_TYPES}")
        if self.rewards.shape != (count,) or self.rewards.dtype != np.float64:
            raise ValueError(f"rewards: {self.rewards.dtype} {self.rewards.shape}: expected float64 ({count},)")
        if len(self.hashes) != count + 1:
            raise ValueError(f"hashes: {len(self.hashes)}: expected one more than the {count} actions")
        width = self.actions.shape[1]
        shape = (width,) if self.action_shape is None else tuple(self.action_shape)
        if not all(_is_seed(n) for n in shape) or (count and math.prod(shape) != width):
            raise ValueError(f"action_shape = {shape}: actions have {width} numbers each")
        object.__setattr__(self, "action_shape", shape)

    def __len__(self) -> int:
        return len(self.actions)

    def action(self, index: int) -> Any:
        """The action that was given at a step (0 is the first), in its own type and shape."""
        row = self.actions[index]
        return row[0] if self.action_shape == () else row.reshape(self.action_shape or row.shape).copy()

    def to_json(self) -> str:
        """The whole episode as JSON text; `from_json` gives back equal bits."""
        document: dict[str, Any] = {"format": EPISODE_FORMAT, "format_version": EPISODE_VERSION}
        for item in fields(self):
            value = getattr(self, item.name)
            document[item.name] = encode_array(value) if isinstance(value, np.ndarray) else value
        return json.dumps(document, allow_nan=False)

    @staticmethod
    def from_json(text: str) -> Episode:
        """Reads `to_json`; every size and type is checked.

        Raises:
            ValueError: no JSON, another format or version, a missing, unknown or wrong field (named).
        """
        if len(text) > MAX_JSON:
            raise ValueError(f"episode: {len(text)} letters are more than {MAX_JSON}")
        try:
            document = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"episode: no JSON ({str(error)[:100]})") from None
        if not isinstance(document, dict) or document.pop("format", None) != EPISODE_FORMAT:
            raise ValueError(f"episode: format is not {EPISODE_FORMAT}")
        version = document.pop("format_version", None)
        if version != EPISODE_VERSION:
            raise ValueError(f"episode: format_version = {version!r}: this version reads {EPISODE_VERSION}")
        return episode_from(document)

    @staticmethod
    def load(path: str | Path) -> Episode:
        """Reads a JSON file; errors name the file."""
        file = Path(path)
        try:
            return Episode.from_json(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ValueError(f"{file}: {error}") from None


def episode_from(document: Mapping[str, Any]) -> Episode:
    """An episode from JSON values; arrays as `encode_array` wrote them, or as numpy.

    Raises:
        ValueError: a missing, unknown or wrong field, by name.
    """
    known = {item.name for item in fields(Episode)}
    if unknown := set(document) - known:
        raise ValueError(f"episode: unknown field {sorted(unknown)[0]!r}")
    needed = ("env_id", "kwargs", "seed", "episode_seed", "options", "actions", "hashes", "rewards")
    for name in needed:
        if name not in document:
            raise ValueError(f"episode: the field {name!r} is missing")
    values = dict(document)
    for name in ("actions", "rewards", "failed_action"):
        if values.get(name) is not None and not isinstance(values[name], np.ndarray):
            values[name] = decode_array(values[name], name)
    for name in ("hashes", "wrappers", "obstacles", "action_shape"):
        if values.get(name) is not None:
            if not isinstance(values[name], list | tuple):
                raise ValueError(f"{name}: expected a list")
            values[name] = tuple(values[name])
    return Episode(**values)


# ---- JSON ----


def encode_array(array: NDArray[Any]) -> dict[str, Any]:
    """An array as JSON: type, shape and the base64 of its little-endian bytes."""
    values = np.asarray(array, order="C")
    data = values.astype(values.dtype.newbyteorder("<")).tobytes()
    return {"dtype": values.dtype.name, "shape": list(values.shape), "base64": base64.b64encode(data).decode()}


def decode_array(value: Any, name: str = "array", types: tuple[str, ...] = ACTION_TYPES) -> NDArray[Any]:
    """Reads `encode_array`.

    Raises:
        ValueError: a type that is not among `types`, a wrong shape, or not as many bytes as the shape needs.
    """
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "base64"}:
        raise ValueError(f"{name}: expected an object of dtype, shape and base64")
    dtype, shape, text = value["dtype"], value["shape"], value["base64"]
    if dtype not in types:
        raise ValueError(f"{name}: dtype = {dtype!r}: expected one of {', '.join(types)}")
    if not isinstance(shape, list) or len(shape) > 4 or not all(_is_seed(n) for n in shape):
        raise ValueError(f"{name}: shape = {shape!r}: expected a list of at most 4 counts")
    if not isinstance(text, str):
        raise ValueError(f"{name}: base64 is no text")
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"{name}: base64 is damaged ({error})") from None
    if len(data) != math.prod(shape) * np.dtype(dtype).itemsize:
        raise ValueError(f"{name}: {len(data)} bytes do not fill {dtype} {tuple(shape)}")
    return np.frombuffer(data, dtype=np.dtype(dtype).newbyteorder("<")).astype(dtype).reshape(shape)


def as_json(value: Any, name: str) -> Any:
    """JSON values for a keyword argument or option, which `from_json_values` turns back.

    Numpy's numbers and arrays keep their type ({"__array__": ...}), for a float32 computes other bits than a float;
    an object that has `to_json` (a Fidelity) becomes {"__json__": its class name, "value": ...}; tuples become lists.

    Raises:
        ValueError: what JSON cannot hold, by the path to it.
    """
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, float):  # np.float64 is one
        if not math.isfinite(value):
            raise ValueError(f"{name} = {value}: must be finite to be recorded")
        return float(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, np.ndarray | np.generic) and value.dtype.name in ARRAY_TYPES:
        return {"__array__": encode_array(np.asarray(value))}
    if isinstance(value, Mapping):
        if not all(isinstance(k, str) for k in value):
            raise ValueError(f"{name}: its keys must be texts to be recorded")
        return {k: as_json(v, f"{name}[{k!r}]") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(v, f"{name}[{i}]") for i, v in enumerate(value)]
    writer = getattr(value, "to_json", None)
    if callable(writer):
        return {"__json__": type(value).__name__, "value": writer()}
    raise ValueError(f"{name}: a {type(value).__name__} cannot be recorded")


def from_json_values(value: Any, name: str, objects: Mapping[str, Callable[[Any], Any]]) -> Any:
    """What `as_json` was given.

    Args:
        value: JSON values.
        name: where they stand, for errors.
        objects: class name -> reader of what its `to_json` wrote; no other object is made.

    Raises:
        ValueError: a damaged array, or another object, by the path to it.
    """
    if isinstance(value, list):
        return [from_json_values(v, f"{name}[{i}]", objects) for i, v in enumerate(value)]
    if not isinstance(value, dict):
        return value
    if set(value) == {"__array__"}:
        return decode_array(value["__array__"], name, ARRAY_TYPES)[()]
    if "__json__" in value:
        if set(value) != {"__json__", "value"} or value["__json__"] not in objects:
            raise ValueError(f"{name}: a {str(value['__json__'])[:80]!r} cannot be made from a file")
        return objects[value["__json__"]](value["value"])
    return {key: from_json_values(v, f"{name}[{key!r}]", objects) for key, v in value.items()}


# ---- versions ----


def environment_versions() -> dict[str, str]:
    """Packages, engine and platform of this process: what a replay has to have in common to be equal to the bit."""
    found = {"python": platform.python_version(), "platform": platform.platform(), "machine": platform.machine()}
    found["processor"] = _processor()
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    found["engine"] = engine_digest()
    return found


@functools.cache
def engine_digest() -> str:
    """Digest of the simulator's own sources, independent of where they are installed."""
    package = Path(__file__).resolve().parents[1]
    apart = ("recording", "benchmarks", "commands")
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package)
        if name.parts[0] not in apart:
            digest.update(name.as_posix().encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def differing_versions(recorded: Mapping[str, str], now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Name -> (recorded, now) of what differs; what only one side knows counts as different."""
    names: Iterable[str] = sorted(set(recorded) | set(now))
    pairs = {name: (recorded.get(name, "none"), now.get(name, "none")) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


# ---- checks ----


def _is_text(value: Any, longest: int) -> bool:
    return isinstance(value, str) and len(value) <= longest


def _is_seed(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _is_object(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(k, str) for k in value) and _is_json(value)


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True
