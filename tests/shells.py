"""The candidates of a word, as a shell asks for them."""

import os
import subprocess
import sys

COMMAND = [sys.executable, "-m", "sparseskin.launch.commands.entry"]


def words(line: str, breaks: str = " \t\n\"'><=;|&(:") -> list[str]:
    """Candidates of the last word of `sparseskin LINE` for bash, with its word breaks."""
    typed = f"sparseskin {line}"
    reader, writer = os.pipe()
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SHELL": "bash",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_COMP_WORDBREAKS": breaks,
        "COMP_TYPE": "9",
        "COMP_LINE": typed,
        "COMP_POINT": str(len(typed)),
    }
    # argcomplete writes to file descriptor 8.
    shell = ["bash", "-c", f'exec 8>&{writer}; exec "$@"', "bash", *COMMAND]
    with os.fdopen(reader) as found:
        subprocess.run(shell, env=environment, pass_fds=[writer], check=True, timeout=120)
        os.close(writer)
        return found.read().splitlines()
