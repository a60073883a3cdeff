"""The `adp` command: its sub-commands, each imported only when it is called."""

import difflib
import importlib
import logging
import os
import sys
from pathlib import Path as FilePath

import click

from adp_path_follower import __version__
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.registry import PLUGINS, load_plugins
from adp_path_follower.resources import docs_page, docs_pages
from adp_path_follower.threads import use_one_blas_thread

_COMMANDS = {
    "analyze": "Turn the bags of runs into one report.",
    "compare": "Compare the controller with its peers, and all with the offline optimum.",
    "demo": "Drive the paper's figure eight with real ROS 2 nodes.",
    "docs": "Print a page of the documentation.",
    "identify": "Find delay, lag, gains, bias and noise of the robot in a bag.",
    "optimum": "Find what the best controller would cost, by offline optimal control.",
    "paper": "Reproduce the paper's figures, and what they do not show.",
    "parameters": "Show the parameters, as a YAML file or as a table.",
    "recover": "Save what can be read of a torn recording into a new bag.",
    "replay": "Feed a bag's odometry to the controller again, with the same or other parameters.",
    "simulate": "Simulate the closed loop without ROS, from one or many starts.",
    "sweep": "Simulate many settings on many starts, paths and robots, on all cores.",
    "tune": "Search for better settings by simulation, on all cores.",
}
# Where a command is, if not in the module of its name.
_HOMES = {"docs": "main", "tune": "sweep"}


class _LazyGroup(click.Group):
    """A group that lists its commands without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        home = _HOMES.get(cmd_name, cmd_name)
        module = importlib.import_module(f"adp_path_follower.cli.{home}")
        command: click.Command = getattr(module, cmd_name)
        _mark_examples(command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            meant = difflib.get_close_matches(args[0], _COMMANDS, 1)
            hint = f"did you mean '{meant[0]}'?" if meant else f"there are {', '.join(_COMMANDS)}"
            ctx.fail(f"No such command '{args[0]}': {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))


def _mark_examples(command: click.Command) -> None:
    r"""Turn the \b above examples, two characters in raw docstrings, into the one click knows."""
    command.help = (command.help or "").replace("\\b\n", "\b\n")


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="adp")
@click.option(
    "--plugin",
    "plugins",
    multiple=True,
    metavar="MODULE|FILE.py",
    help="Import what registers a basis, a far policy or a peer of your own; may be given several "
    "times. For nodes, set ADP_PLUGINS to the same, with commas between.",
)
def adp(plugins: tuple[str, ...]) -> None:
    r"""Follow paths with a unicycle robot by online approximate optimal control.

    \b
    See it:          adp demo
    Try a setting:   adp simulate --params paper --set actor_gain=2
    All settings:    adp parameters

    Every command answers to --help.
    """
    if plugins:  # also for the nodes and workers that a command starts, wherever they run
        given = [
            str(FilePath(name).resolve()) if name.endswith(".py") else name for name in plugins
        ]
        os.environ[PLUGINS] = ",".join([*given, os.environ.get(PLUGINS, "")])
        load_plugins()


_mark_examples(adp)


@click.command()
@click.argument("page", required=False)
def docs(page: str | None) -> None:
    r"""Print a page of the documentation; without PAGE, name the pages.

    \b
    One page:   adp docs safety
    The names:  adp docs
    """
    if page is None:
        click.echo("\n".join(docs_pages()))
    else:
        click.echo(docs_page(page).read_text(encoding="utf-8"), nl=False)


def main() -> None:
    """Run the command; a bad input is one sentence and exit code 2."""
    use_one_blas_thread()
    log = logging.getLogger("adp_path_follower")  # says what takes long, beside the output
    log.handlers, log.level = [logging.StreamHandler()], logging.INFO
    try:
        code = adp.main(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("adp: interrupted", err=True)
        code = 130
    except AdpError as error:
        click.echo(f"adp: {error}", err=True)
        code = 2
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone
        code = 141
    except OSError as error:  # unexpected, such as a full disk
        where = "" if error.filename is None else f"file {error.filename}: "
        click.echo(f"adp: {where}{error.strerror or error}", err=True)
        code = 2
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
