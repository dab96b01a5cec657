"""The commands, one file each. Importing them must stay cheap: `--help` answers at once."""

from __future__ import annotations

import typer

from Workstation.commands import (
    batch,
    demo,
    echo,
    emulate,
    evaluate,
    markers,
    plausibility,
    plugins,
    register,
    selftest,
    study,
    surface,
    tracker,
    workstation,
)
from Workstation.commands import test as suite

app = typer.Typer(
    help="Non-invasive patient registration for skull surgery. Research software, not a medical device.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # plain help comes twice as fast
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Every command takes --debug to show tracebacks.",
)
app.command("demo")(demo.demo)
app.command("test", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(suite.test)
app.command("surface")(surface.surface)
app.command("markers")(markers.markers)
app.command("register")(register.register)
app.command("batch")(batch.batch)
app.command("evaluate")(evaluate.evaluate)
app.command("plausibility")(plausibility.plausibility)
app.command("study")(study.study)
app.command("echo")(echo.echo)
app.add_typer(emulate.app, name="emulate")
app.add_typer(tracker.app, name="tracker")
app.command("selftest")(selftest.selftest)
app.command("plugins")(plugins.plugins)
app.command("workstation")(workstation.workstation)
