"""`levid completion`: print the script that completes commands, options and files in a shell."""

from __future__ import annotations

import sys

import click
from click.shell_completion import (
    BashComplete,
    FishComplete,
    ShellComplete,
    ZshComplete,
    add_completion_class,
)

from .progress import say

_INSTALL = {
    "bash": "echo 'source <(levid completion bash)' >> ~/.bashrc",
    "zsh": "echo 'source <(levid completion zsh)' >> ~/.zshrc",
    "fish": "levid completion fish > ~/.config/fish/completions/levid.fish",
}

# click completes all files alike. The type `path` is that of cli/path_types.py: a file or, with a
# final slash, a folder, after which the shell adds no space.
_BASH = """\
%(complete_func)s() {
    local IFS=$'\\n' response completion type value
    response=$(env COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD \\
        %(complete_var)s=bash_complete "$1" 2> /dev/null)
    for completion in $response; do
        type=${completion%%%%,*} value=${completion#*,}
        case $type in
            plain) COMPREPLY+=("$value") ;;
            path) compopt -o filenames; COMPREPLY+=("${value%%/}") ;;
            dir) COMPREPLY=(); compopt -o dirnames ;;
            file) COMPREPLY=(); compopt -o default ;;
        esac
    done
}
complete -o nosort -F %(complete_func)s %(prog_name)s
"""
_ZSH = """\
#compdef %(prog_name)s
%(complete_func)s() {
    local -a plain described files folders response
    local type key descr
    (( ! $+commands[%(prog_name)s] )) && return 1
    response=("${(@f)$(env COMP_WORDS="${words[*]}" COMP_CWORD=$((CURRENT-1)) \\
        %(complete_var)s=zsh_complete %(prog_name)s 2> /dev/null)}")
    for type key descr in ${response}; do
        case $type in
            plain) [[ $descr == _ ]] && plain+=("$key") || described+=("$key:$descr") ;;
            path) [[ $key == */ ]] && folders+=("$key") || files+=("$key") ;;
            dir) _path_files -/ ;;
            file) _path_files -f ;;
        esac
    done
    (( $#described )) && _describe -V unsorted described -U
    (( $#plain )) && compadd -U -V unsorted -a plain
    (( $#files )) && compadd -U -a files
    (( $#folders )) && compadd -U -S '' -a folders
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    %(complete_func)s "$@"
else
    (( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
    compdef %(complete_func)s %(prog_name)s
fi
"""
_FISH = """\
function %(complete_func)s
    set -l response (env %(complete_var)s=fish_complete COMP_WORDS=(commandline -cp) \\
        COMP_CWORD=(commandline -t) %(prog_name)s 2> /dev/null)
    for completion in $response
        set -l part (string split --max 1 "," $completion)
        switch $part[1]
            case plain path
                echo $part[2]
            case dir
                __fish_complete_directories $part[2]
            case file
                __fish_complete_path $part[2]
        end
    end
end
complete --no-files --command %(prog_name)s --arguments "(%(complete_func)s)"
"""


class _Bash(BashComplete):
    source_template = _BASH

    @staticmethod
    def _check_version() -> None:
        """Start no bash to ask for its version: every bash since 2016 knows these options."""


class _Zsh(ZshComplete):
    source_template = _ZSH


class _Fish(FishComplete):
    source_template = _FISH


_SHELLS: dict[str, type[ShellComplete]] = {"bash": _Bash, "zsh": _Zsh, "fish": _Fish}


def register() -> None:
    """Make click use these scripts and formats."""
    for name, shell in _SHELLS.items():
        add_completion_class(shell, name)


@click.command("completion")
@click.argument("shell", metavar="SHELL", type=click.Choice(list(_SHELLS)))
@click.pass_context
def command(ctx: click.Context, shell: str) -> int:
    """Print the completion script of SHELL: bash, zsh or fish.

    With it, the Tab key completes commands, options and file names. Files are offered by kind: a
    session for `levid excite`, logs for `levid identify`.

    \b
    Examples:
      levid completion bash
      echo 'source <(levid completion bash)' >> ~/.bashrc
      echo 'source <(levid completion zsh)' >> ~/.zshrc
      levid completion fish > ~/.config/fish/completions/levid.fish
    """
    root = ctx.find_root()
    script = _SHELLS[shell](root.command, {}, "levid", "_LEVID_COMPLETE").source()
    # zsh reads "#compdef" only from the first line.
    first, _, rest = script.partition("\n")
    install = f"# To install: {_INSTALL[shell]}"
    click.echo(
        f"{first}\n{install}\n{rest}" if shell == "zsh" else f"{install}\n{script}", nl=False
    )
    if sys.stdout.isatty():
        say(f"to install: {_INSTALL[shell]}")
    return 0
