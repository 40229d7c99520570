"""Flags of commands: each command defines its own, and those that several have are alike."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from absl import flags, logging

from envs_host.pool import WorkerError
from jaxnew.loop import InterruptedRunError
from jaxnew.storage.progress import lasting
from jaxnew.task.places import UsageError, trusting

# Flags of several commands: kind, default, help.
_SHARED: dict[str, tuple[str, Any, str]] = {
    "task": ("string", "grid_world", "Task name, or package.module:TASK."),
    "method": (
        "string",
        "ours",
        "ours, modulated, no-entropy, no-subsampling, continuous, nearest-neighbour, random, or "
        "package.module:NAME of a callable (MethodContext) -> PolicyMethod.",
    ),
    "representation": (
        "string",
        "hvae",
        "Engineered vectors by name (gt12), hvae or vae with an optional -MODALITY (hvae-onehot), "
        "-changes (mean changes appended) and -oracle (trained on all actions), random-SIZE, a run "
        "directory of embed, an .npz table, or pretrained:NAME.",
    ),
    "representation_budget": (
        "string",
        None,
        "Budget of a representation that has to be trained; default: --budget.",
    ),
    "split": ("string", None, "Name of the split; default: the task's first."),
    "split_seed": ("integer", 0, "Seed of the split, where it can be drawn anew."),
    "budget": ("string", "laptop", "smoke, laptop or paper; some tasks have more."),
    "seed": ("integer", 31, "Seed of the run."),
    "workdir": ("string", None, "Directory of the run; default: below --runs."),
    "runs": ("string", "runs", "Where runs and what they share are kept."),
    "overwrite": ("bool", False, "Replace an existing run instead of resuming."),
    "workers": ("integer", 0, "Processes for environments on the host; 0: one per core."),
    "set": (
        "multi_string",
        [],
        "path.to.field=value, for any field of the config, those of the environment "
        "(environment.FIELD) included; pool.FIELD=value says how environments on the host are run.",
    ),
    "recordings": (
        "integer",
        None,
        "Recordings per action; default: what the budget says.",
    ),
    "universe": (
        "string",
        "",
        "Whose actions: another list of the domain (CREATE: 15-degrees, 3-degrees), or a file of "
        "one's own (skills, shapes); default: the task's own.",
    ),
    "frames": (
        "enum",
        None,
        "Of videos: on-demand draws the frames of each batch while the batch before is learned "
        "from, stored draws all frames once and stores them. The result is the same; default: what "
        "the budget says.",
    ),
    "trust": (
        "bool",
        False,
        "Import modules that a run names as its task or method, though they are not installed.",
    ),
    "debug_nans": ("bool", False, "Stop at the operation that makes a NaN."),
}
# Flags that say what is trained, and on what.
TRAINED = (
    *("task", "method", "representation", "representation_budget"),
    *("split", "split_seed", "budget"),
)
_OPTIONS: dict[str, dict[str, Any]] = {
    "workers": {"lower_bound": 0},
    "recordings": {"lower_bound": 1},
    "frames": {"choices": ["on-demand", "stored"]},
}


class _NumbersParser(flags.ListParser):
    """Numbers that are separated by commas."""

    def __init__(self, kind: type[int] | type[float]) -> None:
        super().__init__()
        self._kind = kind

    def parse(self, argument: Any) -> list[Any]:
        return [self._kind(text) for text in super().parse(argument)]


class Arguments:
    """The flags of one command, and how it begins and ends; `arguments.NAME` is a flag's value.

    Args:
      doc: the docstring of the command's module, shown by `--help`.
      shared: names of flags that other commands have, too.
    """

    def __init__(self, doc: str, *shared: str) -> None:
        self._doc = doc
        self._values = flags.FlagValues()
        self._texts: dict[str, str] = {}
        for name in shared:
            kind, default, text = _SHARED[name]
            self.define(kind, name, default, text, **_OPTIONS.get(name, {}))

    def define(self, kind: str, name: str, default: Any, text: str, **options: Any) -> None:
        """Defines a flag: `kind` is string, integer, float, bool, list, enum or multi_string; or
        integers or floats, a list of numbers.
        """
        make: Any = getattr(flags, f"DEFINE_{kind}", None)
        if make is None:
            parser = _NumbersParser({"integers": int, "floats": float}[kind])
            flags.DEFINE(parser, name, default, text, self._values, **options)
        elif kind == "enum":
            make(name, default, options["choices"], text, flag_values=self._values)
            text = f"{', '.join(options['choices'])}. {text}"
        else:
            make(name, default, text, flag_values=self._values, **options)
        self._texts[name] = f"{text} Repeatable." if kind == "multi_string" else text

    def __getattr__(self, name: str) -> Any:
        return getattr(self._values, name)

    def of(self, *names: str) -> dict[str, Any]:
        """Values of flags by their names, for a function whose arguments are called like them."""
        return {name: getattr(self, name) for name in names}

    def is_given(self, name: str) -> bool:
        """Whether a flag stands on the command line."""
        return bool(self._values[name].present)

    def refuse(self, names: Sequence[str], mode: str) -> None:
        """Refuses flags that mean nothing in a mode of the command.

        Raises:
          UsageError: one of them stands on the command line.
        """
        given = [f"--{name}" for name in names if self.is_given(name)]
        if given:
            raise UsageError(f"{', '.join(given)}: of no meaning {mode}; leave it out.")

    @property
    def path(self) -> Path | None:
        """`--workdir` as a path."""
        return Path(self.workdir) if self.workdir else None

    @property
    def stores_drawn(self) -> bool | None:
        """What `--frames` says; None if nothing."""
        return None if self.frames is None else bool(self.frames == "stored")

    def parse(self, arguments: list[str]) -> None:
        """Reads a command line, without the program's name; flags that it lacks have defaults.

        A `~` where a path begins is the user's home, as shells have it elsewhere.

        Raises:
          UsageError: it has something that is no flag of this command, or a value is illegal, or
            empty where an empty one says nothing.
        """
        for name in self._texts:
            self._values[name].unparse()
        everything = flags.FlagValues()
        everything.append_flag_values(self._values)
        everything.append_flag_values(_of_absl())
        try:
            rest = everything(["jaxnew", *map(_at_home, arguments)])
        except flags.Error as err:
            raise UsageError(f"{err} (--help lists the flags.)") from err
        if len(rest) > 1:
            raise UsageError(f"Unknown argument {rest[1]!r}; every option is a --flag=value.")
        self._values.mark_as_parsed()
        flags.FLAGS.mark_as_parsed()
        for name in self._texts:
            flag = self._values[name]
            if flag.present and flag.value in ("", []) and flag.default != "":
                raise UsageError(f"--{name} is empty; give a value, or leave it out.")

    def help_text(self, with_absl: bool = False) -> str:
        """What `--help` shows, and `--helpfull`."""
        lines = [self._doc.strip(), "", "Flags:"]
        for name, text in self._texts.items():
            found = self._values[name].default
            shown = ",".join(map(str, found)) if isinstance(found, list) else found
            default = "" if found in (None, []) else f" Default: {shown}."
            wrapped = textwrap.wrap(f"{text}{default}", 94)
            lines += [f"  --{name}", *(f"      {line}" for line in wrapped)]
        if with_absl:
            lines += ["", "Flags of absl:", _of_absl().get_help("  ")]
        return "\n".join(lines)

    def start(self, main: Callable[[], int | None], arguments: list[str] | None = None) -> None:
        """Runs a command's `main`; a user's mistake ends it with one line, not a traceback.

        A signal ends it with the status 128 + its number, at once or, where `main` returns the
        number, after what was begun has been saved.
        """
        arguments = sys.argv[1:] if arguments is None else arguments
        with contextlib.redirect_stdout(lasting(sys.stdout)):
            for word, is_full in (("--helpfull", True), ("--help", False)):
                if word in arguments:
                    print(self.help_text(is_full), flush=True)
                    return
            try:
                self.parse(arguments)
            except UsageError as err:
                sys.exit(f"UsageError: {err}")
            stopped_by = self._run(main)
        if stopped_by is not None:
            sys.exit(128 + stopped_by)

    def _run(self, main: Callable[[], int | None]) -> int | None:
        """Runs `main`; returns the number of the signal that stopped it, if one did."""
        if not flags.FLAGS["verbosity"].present:
            logging.set_verbosity(logging.WARNING)  # Orbax logs every file it writes.
        debugs = False
        if "debug_nans" in self._texts:  # What computes has it.
            configure_jax()
            debugs = self.debug_nans
        with (
            jax_debug_nans() if debugs else contextlib.nullcontext(),
            trusting("trust" in self._texts and self.trust),
        ):
            try:
                return main()
            except InterruptedRunError as err:
                print(err)
                return err.number
            except KeyboardInterrupt:
                if os.environ.get("JAXNEW_TRACEBACK"):
                    raise
                print("Stopped by Ctrl-C.")
                return signal.SIGINT
            except (ValueError, ArithmeticError, WorkerError, OSError) as err:
                is_nameless = isinstance(err, OSError) and err.filename is None
                if is_nameless or debugs or os.environ.get("JAXNEW_TRACEBACK"):
                    raise
                sys.exit(f"{type(err).__name__}: {_said(err)}\n{_advice(err)}")


def _of_absl() -> flags.FlagValues:
    """The flags that absl defines by itself."""
    own = flags.FlagValues()
    for module, listed in flags.FLAGS.flags_by_module_dict().items():
        if module.startswith("absl"):
            for flag in listed:
                own[flag.name] = flag
    return own


def _at_home(word: str) -> str:
    """A word of a command line, with the home of the user (`--run=~/a,~/b`) as shells write it."""
    return re.sub(r"(?<=[=,])~[^/,=]*(?=[/,]|$)", lambda found: os.path.expanduser(found[0]), word)


def configure_jax() -> None:
    """Compiled programs are kept between processes, where the user's variables say nothing else."""
    import jax

    wanted: dict[str, Any] = {"jax_persistent_cache_min_compile_time_secs": 1.0}
    with contextlib.suppress(RuntimeError):  # There are users without a home.
        wanted["jax_compilation_cache_dir"] = str(Path.home() / ".cache" / "jaxnew")
    for name, value in wanted.items():
        if name.upper() not in os.environ:
            jax.config.update(name, value)


def jax_debug_nans() -> contextlib.AbstractContextManager[None]:
    """JAX stops at the operation that makes a NaN."""
    import jax

    return jax.debug_nans(True)


def _said(err: Exception) -> str:
    """What an error says, in one line."""
    if isinstance(err, OSError):
        return f"{err.filename}: {err.strerror}. Give a path that is there and that you may use."
    return str(err)


def _advice(err: Exception) -> str:
    if isinstance(err, WorkerError):
        return (
            "The same command goes on from the last checkpoint; with "
            "--set=pool.on_worker_death=restart it replaces workers that are lost."
        )
    return "(JAXNEW_TRACEBACK=1 shows where.)"
