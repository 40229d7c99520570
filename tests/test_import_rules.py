"""Who may import whom, read from the source, also inside functions; and the face of `jaxnew`."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxnew

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("jaxnew", "envs_mjx", "envs_host", "experiments", "examples")

# Layers of `jaxnew`, lowest first. A module may import lower layers; within one layer, only along
# `SIDEWAYS`, which names parts, or modules of them. Files, metrics, configs and the like know
# nothing of what is learned.
LAYERS = (
    {"actions", "cores", "host_checks", "storage", "observations", "collection"},
    {"sampling", "environment", "convolution", "finiteness", "optimizer"},
    {"policy", "representation"},
    {"rollout", "ppo"},
    {"loop", "evaluation"},
    {"task"},
    {"checks"},
    {
        "recording",
        "embedding",
        "trainer",
        "new_actions",
        "results",
        "run",
        "runs",
        "training",
        "sweeping",
        "comparison",
    },
)
SIDEWAYS = {
    "comparison": {"run"},
    "actions": {"storage.files"},
    "observations": {"actions", "storage"},
    "collection": {"actions", "observations", "storage"},
    "ppo": {"rollout"},
    "embedding": {"recording"},
    "new_actions": {"trainer"},
    "run": {"embedding", "new_actions", "results", "trainer"},
    "training": {"embedding", "run", "trainer"},
    "runs": {"results", "run"},
    "sweeping": {"run", "runs", "trainer", "training"},
}

# Of `experiments`, lowest first; commands and benchmarks are above them.
EXPERIMENTS = ("tasks", "main", "reports", "untrained", "flags")

HEAVY = {
    "brax": {"envs_mjx.brax_adapter"},
    "mujoco": {"envs_mjx.shape_stacking"},
}
HOST_MAY_IMPORT = {
    "envs_host",
    "numpy",
    "pymunk",
    "gymnasium",
    "PIL",
    "jaxnew.actions",
    "jaxnew.cores",
    "jaxnew.host_checks",
}


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(root: Path = ROOT) -> dict[str, Path]:
    return {
        module_name(path, root): path
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
    }


MODULES = modules()


def resolve(name: str, names: Iterator[str] | list[str], known: dict[str, Path]) -> Iterator[str]:
    """`from package import module` imports the module, `from module import function` the module."""
    for part in names:
        yield f"{name}.{part}" if f"{name}.{part}" in known else name


def imports_of(path: Path, known: dict[str, Path] = MODULES, root: Path = ROOT) -> set[str]:
    """Dotted names of the modules that a file imports, at its top or in any function.

    `if TYPE_CHECKING` counts as well: a type is knowledge of the other side.
    """
    own_package = module_name(path, root).split(".")
    if path.name != "__init__.py":
        own_package = own_package[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = own_package[: len(own_package) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            found |= set(resolve(base, [alias.name for alias in node.names], known))
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) in ("importlib.import_module", "import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            found.add(node.args[0].value)
    return found


IMPORTS = {name: imports_of(path) for name, path in MODULES.items()}


def is_within(name: str, allowed: set[str]) -> bool:
    return any(name == a or name.startswith(a + ".") for a in allowed)


def is_ours(name: str) -> bool:
    return is_within(name, set(PACKAGES))


def layer_of(module: str) -> int:
    """Index into `LAYERS`."""
    part = module.split(".")[1]
    for layer, parts in enumerate(LAYERS):
        if part in parts:
            return layer
    raise AssertionError(
        f"{module} has no layer; add `{part}` to LAYERS in {Path(__file__).name} where it belongs."
    )


def violations(imports: dict[str, set[str]]) -> list[str]:
    """Every import against the rules, as `importer -> imported: why`."""
    found = []
    for module, names in imports.items():
        package = module.split(".")[0]
        for name in sorted(names):
            why = why_not(module, package, name)
            if why:
                found.append(f"{module} -> {name}: {why}")
    return found


def why_not(module: str, package: str, name: str) -> str | None:
    for library, users in HEAVY.items():
        if is_within(name, {library}) and package != "experiments" and not is_within(module, users):
            return f"only {sorted(users)} may import {library}, which takes seconds"
    if is_within(name, {"absl"}) and package != "experiments":
        return "flags are of commands"
    if package == "jaxnew":
        others = {"envs_mjx", "envs_host", "experiments", "examples", "gymnasium", "pymunk"}
        if is_within(name, others):
            return "the method knows no simulator and no experiment"
        if is_within(name, {"jaxnew"}):
            return why_not_within_jaxnew(module, name)
    if package == "envs_mjx" and is_ours(name):
        ours = {"actions", "cores", "environment", "observations"}
        allowed = {"envs_mjx", *(f"jaxnew.{name}" for name in ours)}
        if not is_within(name, allowed):
            return f"envs_mjx may import {sorted(allowed)} of ours"
    if package == "examples" and is_ours(name) and not is_within(name, {"examples", "jaxnew"}):
        return "a domain or policy of one's own needs jaxnew only"
    if package == "experiments" and is_within(name, {"examples"}):
        return "experiments find what is the user's own by its place"
    if package == "experiments" and is_within(name, {"experiments"}):
        here, there = (floor_of(each) for each in (module, name))
        if there > here:
            return f"what commands share is layered {EXPERIMENTS}, and knows no command"
    if package == "envs_host":
        is_standard = name.split(".")[0] in {*sys.stdlib_module_names, "__future__"}
        if not is_standard and not is_within(name, HOST_MAY_IMPORT):
            return f"host workers may import {sorted(HOST_MAY_IMPORT)}"
    return None


def floor_of(module: str) -> int:
    """Index into `EXPERIMENTS`, beyond its end for commands; -1 for the empty package itself."""
    parts = module.split(".")
    if len(parts) == 1:
        return -1
    return EXPERIMENTS.index(parts[1]) if parts[1] in EXPERIMENTS else len(EXPERIMENTS)


def why_not_within_jaxnew(module: str, name: str) -> str | None:
    if module == "jaxnew":
        return "the face of the package loads lazily"
    if name == "jaxnew":
        return "import the module and not the package's face"
    here, there = module.split(".")[1], name.split(".")[1]
    is_down = layer_of(name) < layer_of(module)
    is_beside = here == there or is_within(name, {f"jaxnew.{n}" for n in SIDEWAYS.get(here, ())})
    return None if is_down or is_beside else f"{here} may not import {there}"


@pytest.mark.unit
def test_imports_keep_to_the_rules() -> None:
    assert len(MODULES) > 40
    assert violations(IMPORTS) == []


@pytest.mark.unit
def test_there_is_no_cycle_between_modules() -> None:
    needs = {
        module: {n for n in names if n in MODULES and n != module}
        for module, names in IMPORTS.items()
    }
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for other in sorted(needs[module]):
                visit(other, (*path, module))
            done.add(module)

    for module in needs:
        visit(module, ())
    assert done == set(MODULES)


@pytest.mark.unit
def test_actions_needs_numpy_and_files_only() -> None:
    def others(module: str) -> set[str]:
        return {n for n in IMPORTS[module] if n.split(".")[0] not in sys.stdlib_module_names}

    assert others("jaxnew.actions") == {"numpy", "numpy.typing", "jaxnew.storage.files"}
    assert others("jaxnew.storage.files") == set()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("path", "line", "message"),
    [
        ("jaxnew/policy/x.py", "import envs_mjx.grid_world", "no simulator"),
        ("jaxnew/loop.py", "def f():\n    from experiments import train", "no simulator"),
        ("jaxnew/ppo/x.py", "from gymnasium import Env", "no simulator"),
        ("jaxnew/sampling.py", "from jaxnew.policy import Categorical", "sampling may not"),
        ("jaxnew/policy/x.py", "from ..ppo import gae", "policy may not import ppo"),
        ("jaxnew/policy/x.py", "from jaxnew import representation", "policy may not import repr"),
        ("jaxnew/rollout/x.py", "import jaxnew.ppo.learner", "rollout may not import ppo"),
        ("jaxnew/rollout/x.py", "from jaxnew import loop", "rollout may not import loop"),
        ("jaxnew/storage/x.py", "from jaxnew.evaluation import measure", "storage may not"),
        ("jaxnew/storage/x.py", "from jaxnew.observations import Recordings", "storage may not"),
        ("jaxnew/observations.py", "from jaxnew import collection", "observations may not import"),
        ("jaxnew/cores.py", "from jaxnew.storage import files", "cores may not import storage"),
        ("jaxnew/environment.py", "from jaxnew.sampling import ActionPool", "environment may not"),
        ("jaxnew/actions.py", "from jaxnew.storage import config", "actions may not import stor"),
        ("jaxnew/evaluation.py", "from jaxnew import loop", "evaluation may not import loop"),
        (
            "jaxnew/evaluation.py",
            "from jaxnew.task.task import Task",
            "evaluation may not import t",
        ),
        ("jaxnew/task/x.py", "from jaxnew.trainer import Trainer", "task may not import trainer"),
        ("jaxnew/trainer.py", "from jaxnew.embedding import embed", "trainer may not import emb"),
        ("jaxnew/embedding.py", "def f():\n    from jaxnew.run import Run", "embedding may not"),
        ("jaxnew/run.py", "from jaxnew.training import train", "run may not import training"),
        ("jaxnew/training.py", "from jaxnew import sweeping", "training may not import sweeping"),
        ("jaxnew/training.py", "from absl import flags", "flags are of commands"),
        ("examples/x.py", "import absl.flags", "flags are of commands"),
        ("jaxnew/__init__.py", "from jaxnew.actions import ActionSplit", "lazily"),
        ("jaxnew/policy/x.py", "from jaxnew import ActionSplit", "face"),
        ("jaxnew/ppo/x.py", "import mujoco.mjx", "takes seconds"),
        ("envs_mjx/grid_world/x.py", "import brax", "takes seconds"),
        ("envs_mjx/grid_world/x.py", "from jaxnew.sampling import draw_sets", "envs_mjx may"),
        ("envs_mjx/grid_world/x.py", "import experiments.train", "envs_mjx may"),
        ("envs_host/x.py", "import jax", "host workers"),
        ("envs_host/x.py", "def f():\n    import jax.numpy as jnp", "host workers"),
        ("envs_host/x.py", "from jaxnew import ActionSplit", "host workers"),
        ("envs_host/x.py", "from jaxnew.environment import Action", "host workers"),
        ("envs_host/x.py", 'import importlib\nimportlib.import_module("jax")', "host workers"),
        ("examples/x.py", "from experiments.tasks.create import TASK", "needs jaxnew only"),
        ("examples/x.py", "from envs_mjx.grid_world import GridWorld", "needs jaxnew only"),
        ("experiments/x.py", "from examples.kicks import TASK", "by its place"),
        ("experiments/main.py", "from experiments.reports import plots", "is layered"),
        ("experiments/reports/x.py", "from experiments import train", "knows no command"),
        ("experiments/reports/x.py", "from experiments.flags import Arguments", "is layered"),
        ("experiments/flags.py", "from experiments import evaluate", "knows no command"),
        ("experiments/tasks/x.py", "import experiments.flags", "is layered"),
        ("experiments/tasks/x.py", "from experiments import main", "is layered"),
        ("jaxnew/task/x.py", "import examples", "no simulator"),
        ("envs_host/create/x.py", "from ...jaxnew.environment import A", "host workers"),
    ],
)
def test_each_rule_is_broken_by_an_example(
    tmp_path: Path, path: str, line: str, message: str
) -> None:
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(line)
    name = module_name(file, tmp_path)
    found = violations({name: imports_of(file, MODULES, tmp_path)})
    assert len(found) >= 1
    assert all(message in violation for violation in found)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("envs_host/x.py", "import os\nimport numpy as np\nimport pymunk\nfrom . import create"),
        ("envs_host/x.py", "from jaxnew.actions import ActionSplit\nfrom jaxnew import actions"),
        ("envs_mjx/shape_stacking/engines/x.py", "import mujoco\nfrom jaxnew import observations"),
        ("jaxnew/ppo/x.py", "from jaxnew.rollout import contract\nfrom .learner import Learner"),
        ("jaxnew/evaluation.py", "import jaxnew.ppo\nfrom jaxnew.storage import files, metrics"),
        ("jaxnew/run.py", "from jaxnew.embedding import TABLE_FILE\nimport jaxnew.trainer"),
        ("jaxnew/sweeping.py", "from jaxnew import runs, training\nfrom jaxnew.task import domain"),
        ("experiments/x.py", "import brax, envs_host, envs_mjx.grid_world, jaxnew.loop, absl"),
        ("experiments/x.py", "from experiments import figures\nimport experiments.reports.plots"),
        ("experiments/x.py", "from experiments.flags import Arguments\nimport jaxnew.training"),
        ("experiments/reports/x.py", "from experiments.main import child\nimport experiments"),
    ],
)
def test_what_the_rules_allow_is_allowed(tmp_path: Path, path: str, line: str) -> None:
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(line)
    name = module_name(file, tmp_path)
    assert violations({name: imports_of(file, MODULES, tmp_path)}) == []


def loaded_after(*statements: str) -> set[str]:
    """Top-level modules in `sys.modules` of a fresh interpreter after the statements."""
    report = "import sys; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*statements, report])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return set(done.stdout.split())


@pytest.mark.unit
def test_a_host_worker_gets_no_jax_through_jaxnew() -> None:
    host_modules = [name for name in MODULES if name.startswith("envs_host")]
    loaded = loaded_after("import jaxnew.actions", *(f"import {name}" for name in host_modules))
    assert {"jaxnew", "numpy", "envs_host"} <= loaded
    assert not loaded & {"jax", "jaxlib", "flax", "optax", "orbax", "chex"}


@pytest.mark.unit
def test_importing_the_package_imports_nothing_else() -> None:
    loaded = loaded_after("import jaxnew", "import envs_mjx", "import envs_host")
    assert {"jaxnew", "envs_mjx", "envs_host"} <= loaded
    assert not loaded & {"numpy", "jax", "flax", "scipy", "mujoco", "pymunk"}


@pytest.mark.unit
def test_a_script_gets_no_command_and_no_flags() -> None:
    """A task is found, and whatever trains it, without a command; no flag of ours is defined."""
    loaded = loaded_after(
        "import sys, jaxnew",
        "from absl import flags",
        "assert jaxnew.load_task('grid_world').name == 'grid_world'",
        "jaxnew.train, jaxnew.embed, jaxnew.sweep, jaxnew.Run",
        "found = {name for name in sys.modules if name.startswith('experiments')}",
        "assert found == {'experiments', 'experiments.tasks', 'experiments.tasks.grid_world'}",
        "modules = flags.FLAGS.flags_by_module_dict()",
        "assert not [m for m in modules if m.startswith(('experiments', 'jaxnew'))], modules",
    )
    assert "envs_mjx" in loaded
    assert not loaded & {"envs_host", "pymunk", "mujoco"}


# The face of the package.


@pytest.mark.unit
def test_every_exported_name_exists_and_is_documented() -> None:
    assert len(jaxnew.__all__) > 30
    for name in jaxnew.__all__:
        found = getattr(jaxnew, name)
        assert found.__name__ == name
        # A dataclass without one of its own is given its signature.
        assert found.__doc__, name
        assert not found.__doc__.startswith(f"{name}("), name
        module = importlib.import_module(found.__module__)
        assert getattr(module, name) is found
    assert set(dir(jaxnew)) == {*jaxnew.__all__, "__version__"}
    with pytest.raises(AttributeError, match="nothing"):
        _ = jaxnew.nothing


@pytest.mark.unit
def test_every_exported_name_is_used_by_a_test() -> None:
    used: set[str] = set()
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxnew"):
                used |= {alias.name for alias in node.names}
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "jaxnew":
                used.add(node.attr)
    assert set(jaxnew.__all__) - used == set()


@pytest.mark.unit
def test_the_version_stands_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = project.get("version", jaxnew.__version__)
    assert jaxnew.__version__ == declared == importlib.metadata.version("jaxnew")


@pytest.mark.unit
def test_types_travel_with_the_package() -> None:
    assert (ROOT / "jaxnew" / "py.typed").is_file()
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert {"py.typed", "*.pyi"} <= set(settings["package-data"]["jaxnew"])
    stub = ast.parse((ROOT / "jaxnew" / "__init__.pyi").read_text())
    told = {
        alias.asname: node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert told == jaxnew._HOMES
