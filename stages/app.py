"""The command line: lists the commands at once, loads a command's module when it is called, explains every error."""

from __future__ import annotations

import errno
import importlib
import os
import sys
from typing import Any

import typer
import typer.core
import typer.main

from pipeline.engine.errors import EpiTransferError, ResourceError
from pipeline.engine.threads import limit_threads

# Name: (module, function or Typer app, help). The modules are heavy, so that --help does not load them.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "run": ("stages.run", "command", "Run every stage of a workflow; what is up to date is skipped."),
    "ingest": ("stages.stage_command", "ingest", "Read photos, logs and bags into frames and their poses."),
    "pair": ("stages.stage_command", "pair", "Choose the pairs of frames that can give depth."),
    "match": ("stages.stage_command", "match", "Find correspondences, guided by the logged pose."),
    "refine": ("stages.stage_command", "refine", "Relative and absolute poses for the depths."),
    "depth": ("stages.stage_command", "depth", "Sparse depth by epipolar transfer, with sigma."),
    "fuse": ("stages.stage_command", "fuse", "Georeferenced points with covariance."),
    "score": ("stages.stage_command", "score", "Depths against LiDAR tiles, or a bag's own sweeps."),
    "sensitivity": (
        "stages.stage_command",
        "sensitivity",
        "What errors of the logged pose do to the depths.",
    ),
    "report": (
        "stages.stage_command",
        "report",
        "One page: what came out, how good, and what to distrust.",
    ),
    "export": ("stages.export", "command", "Points in another format: laz, las, ply, gpkg, csv, parquet."),
    "example": ("stages.example", "command", "Write a small synthetic flight with its truth."),
    "inspect": ("stages.inspect", "command", "Tell what photos, logs, bags, tiles or tables hold."),
    "configure": ("stages.configure", "command", "Keep a workflow in a run folder, with slices of it for Make."),
    "status": ("stages.status", "command", "Tell which stages are fresh, stale or missing, and why."),
    "models": ("stages.models", "app", "List, fetch and verify the weights of the networks."),
    "schema": ("stages.schema", "command", "Show the tables: column, type, unit, frame, meaning."),
    "doctor": (
        "stages.doctor",
        "command",
        "Check versions, weights, PROJ grids, GPU, disk and memory.",
    ),
}


class _Deferred(typer.core.TyperCommand):
    """A command that is known by name and help until it is called."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        module, name, _ = COMMANDS[str(self.name)]
        found = getattr(importlib.import_module(module), name)
        if not isinstance(found, typer.Typer):  # which a command of several is
            single = typer.Typer(add_completion=False, rich_markup_mode=None)
            single.command(self.name, help=self.help)(found)
            found = single
        return typer.main.get_command(found).make_context(info_name, args, parent=parent, **extra)


class _Commands(typer.core.TyperGroup):
    """The commands in the order the data flows."""

    def list_commands(self, ctx: Any) -> list[str]:
        del ctx
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        del ctx
        return _Deferred(cmd_name, help=COMMANDS[cmd_name][2]) if cmd_name in COMMANDS else None

    def invoke(self, ctx: Any) -> Any:
        # Typer would end an interrupt without a word, and a closed pipe with the exit code of a bug.
        try:
            outcome = super().invoke(ctx)
            sys.stdout.flush()
        except KeyboardInterrupt as interrupt:
            raise typer.Abort from interrupt
        except BrokenPipeError:
            # The reader of our output is gone (a pipe into head), and nothing more can be said.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        return outcome


# Plain help: rich's import alone would take a third of the time --help may take.
app = typer.Typer(cls=_Commands, add_completion=False, no_args_is_help=True, rich_markup_mode=None)


@app.callback(invoke_without_command=True)
def _root(
    version: bool = typer.Option(False, "--version", help="Show the version and leave."),
) -> None:
    """Metric depth from two drone frames and their logged poses, as georeferenced points with honest uncertainties."""
    if version:
        from importlib.metadata import version as installed  # noqa: PLC0415 - only here

        typer.echo(installed("epitransfer"))
        raise typer.Exit


def main() -> None:
    """The console command: runs it and turns every outcome into an exit code of the contract."""
    limit_threads()
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Runs a command line.

    Args:
        arguments: Without the program's name.

    Returns:
        The exit code.
    """
    try:
        command = typer.main.get_command(app)
        return int(command.main(arguments, prog_name="epitransfer", standalone_mode=False) or 0)
    except typer.TyperException as error:
        return _usage(error)
    except EpiTransferError as error:
        return _explain(error)
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("interrupted; the same command carries on\n")
        return 130
    except MemoryError:
        return _explain(ResourceError("E-RES-01", "out of memory", hint="use --jobs 1 or a smaller match.max_image_px"))
    except OSError as error:
        return _explain(_resource(error)) if error.errno in _REASONS else _bug()
    except Exception:  # noqa: BLE001 - the one boundary where everything ends
        return _bug()


_REASONS = {
    errno.ENOSPC: ("E-RES-02", "the disk is full", "free some space; the same command carries on"),
    errno.EDQUOT: ("E-RES-02", "the disk quota is used up", "free some space; the same command carries on"),
    errno.EACCES: ("E-RES-03", "no permission", "check the owner and the mode of the folder"),
    errno.EPERM: ("E-RES-03", "no permission", "check the owner and the mode of the folder"),
    errno.EROFS: ("E-RES-03", "the file system is read-only", "write somewhere else"),
    errno.ENOMEM: ("E-RES-01", "out of memory", "use --jobs 1 or a smaller match.max_image_px"),
    errno.EFBIG: (
        "E-RES-02",
        "a file would be larger than allowed",
        "raise the limit (ulimit -f); the same command carries on",
    ),
    errno.EMFILE: ("E-RES-05", "too many open files", "raise the limit (ulimit -n), or use --jobs 1"),
    errno.EIO: ("E-RES-06", "the disk or network fails", "check it; the same command carries on"),
    errno.ENOTDIR: ("E-RES-04", "not a folder", "give a folder"),
}


def _resource(error: OSError) -> ResourceError:
    code, message, hint = _REASONS[error.errno or 0]
    return ResourceError(code, message, where=str(error.filename or ""), found=str(error), hint=hint)


def _usage(error: typer.TyperException) -> int:
    # The command's usage comes with it, where a command was found.
    show = getattr(error, "show", None)
    if show:
        show()
    else:
        sys.stderr.write(f"error: {error}\n")
    return error.exit_code


def _explain(error: EpiTransferError) -> int:
    sys.stderr.write(f"{error}\n")
    return error.exit_code


def _bug() -> int:
    import traceback  # noqa: PLC0415 - slow to import, and rarely needed

    sys.stderr.write(traceback.format_exc())
    sys.stderr.write("error[E-BUG]: this is a bug; please report it with the lines above and the run's manifest.json\n")
    return 1
