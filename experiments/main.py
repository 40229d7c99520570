"""The command `jaxnew`: `jaxnew train ...` is `python -m experiments.train ...`, in any folder."""

from __future__ import annotations

import ast
import importlib
import os
import signal
import sys
from pathlib import Path

import experiments
from jaxnew.cores import signal_at_parents_end

COMMANDS = (
    "collect",
    "embed",
    "train",
    "evaluate",
    "compare",
    "sweep",
    "finetune",
    "figures",
    "analyze",
    "anchors",
    "demo",
)


# In the environment of a `child`: the process that started it.
_PARENT = "JAXNEW_PARENT"


def main() -> None:
    """Runs the command that the first argument names."""
    parent = os.environ.pop(_PARENT, None)
    if parent is not None:
        signal_at_parents_end(signal.SIGTERM)  # It saves and ends: nobody waits for it any more.
        if parent != str(os.getppid()):
            sys.exit(f"Process {parent}, which started this one, is gone.")
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h", "help"):
        print("jaxnew COMMAND [--flag=value ...]\n")
        for command in COMMANDS:
            print(f"  {command:16}{summary(command)}")
        print("\njaxnew COMMAND --help lists the flags of a command.")
        return
    if name not in COMMANDS:
        sys.exit(f"Unknown command {name!r}; there are {', '.join(COMMANDS)}.")
    # Last, so that a user's modules are found and none of them stands in for one of ours.
    sys.path.append(os.getcwd())
    module = importlib.import_module(f"experiments.{name}")
    sys.argv = [f"jaxnew {name}", *arguments]
    module.ARGUMENTS.start(module.main)


def summary(name: str) -> str:
    """What a command does, in one line; nothing is imported for it."""
    source = Path(__file__).with_name(f"{name}.py").read_text()
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


def child(name: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """A command line and the variables of a process that runs a command of this installation."""
    root = str(Path(experiments.__file__).parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    line = [sys.executable, "-P", "-m", "experiments.main", name, *arguments]
    jax = sys.modules.get("jax")
    debugs = {"JAX_DEBUG_NANS": "1"} if jax is not None and jax.config.jax_debug_nans else {}
    return line, {**os.environ, "PYTHONPATH": path, **debugs, _PARENT: str(os.getpid())}


if __name__ == "__main__":
    main()
