"""`magtwin completion`: tab completion for a shell."""

from typing import Literal

from magtwin.cli.app import app
from magtwin.cli.terminal import Done


@app.command
def completion(shell: Literal["bash", "zsh", "fish"]) -> Done:
    """Print a script that completes magtwin's commands and options in a shell.

    bash: magtwin completion bash > ~/.local/share/bash-completion/completions/magtwin
    zsh: magtwin completion zsh > a folder of $fpath, as _magtwin
    fish: magtwin completion fish > ~/.config/fish/completions/magtwin.fish

    Parameters
    ----------
    shell
        Shell that will read the script.
    """
    script = app.generate_completion(shell=shell)
    return Done(text=script.rstrip("\n"), data={"shell": shell, "script": script})
