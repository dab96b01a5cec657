"""`cranionav`: the command line. Heavy imports wait until a command needs them."""

from __future__ import annotations

import os
import sys
import traceback

DONE, DEFECT, REFUSED = 0, 1, 2


def main() -> None:
    """Run the command line and end the process with its exit status."""
    arguments = sys.argv[1:]
    debug = "--debug" in arguments
    sys.exit(run([argument for argument in arguments if argument != "--debug"], debug))


def run(arguments: list[str], debug: bool = False) -> int:
    """Exit status of one call: 0 done, 2 the input was refused (one line says why), 1 a defect.

    Parameters
    ----------
    arguments : the words after `cranionav`
    debug : show tracebacks
    """
    from CranioNavLib.errors import InputError
    from typer.exceptions import Abort, Exit, TyperException

    from Workstation.commands import app

    try:
        return int(app(arguments, prog_name="cranionav", standalone_mode=False) or DONE)
    except TyperException as error:  # an unknown command or option, a missing argument
        context = getattr(error, "ctx", None)
        return _refuse(error.format_message() + (f" (see {context.command_path} --help)" if context else ""), debug)
    except InputError as error:
        return _refuse(str(error), debug)
    except (Abort, KeyboardInterrupt):
        return _refuse("interrupted", debug)
    except Exit as end:
        return end.exit_code
    except BrokenPipeError:  # the reader of a pipe has gone: nobody is left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        if debug:
            traceback.print_exc()
        print(
            f"cranionav: this is a defect: {type(error).__name__}: {error} (call again with --debug and report it)",
            file=sys.stderr,
        )
        return DEFECT


def _refuse(message: str, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"cranionav: {' '.join(message.split())}", file=sys.stderr)
    return REFUSED


if __name__ == "__main__":
    main()
