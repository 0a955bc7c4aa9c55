"""Completion of ``cfb`` in bash, zsh and fish: commands, options and choices, otherwise file names."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

from cfb_mjx.commands import COMMANDS, load
from cfb_mjx.commands.command import held, is_positional
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_text

_PLACES = {
    "bash": ("XDG_DATA_HOME", ".local/share", "bash-completion/completions/cfb"),
    "zsh": ("ZDOTDIR", "", ".zfunc/_cfb"),
    "fish": ("XDG_CONFIG_HOME", ".config", "fish/completions/cfb.fish"),
}
_HINTS = {
    "bash": "it works in new shells with bash-completion",
    "zsh": "add 'fpath+=~/.zfunc; autoload -Uz compinit; compinit' to ~/.zshrc and start a new shell",
    "fish": "it works in new shells",
}


def install(shell: str) -> str:
    """Install the completion of a shell in the user's folders, and return a message with its path.

    Raises:
        CfbError: the shell is not supported, or the file cannot be written.
    """
    if shell not in _PLACES:
        raise CfbError(f"--install-completion {shell}: choose from {', '.join(_PLACES)}.")
    variable, usual, name = _PLACES[shell]
    path = Path(os.environ.get(variable) or Path.home() / usual) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, script(shell))
    return f"completion: {path}\n{_HINTS[shell]}"


def script(shell: str) -> str:
    """Return the source of a shell's completion."""
    return {"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](_options())


def _options() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the options of every command, with their choices (empty: any word)."""
    found = {}
    for name in COMMANDS:
        hints = get_type_hints(load(name), include_extras=True)
        found[name] = {"--help": ()}
        for one in fields(load(name)):
            kind = held(hints[one.name])
            choices = tuple(map(str, get_args(kind))) if get_origin(kind) is Literal else ()
            if not is_positional(hints[one.name]):
                found[name][f"--{one.name.replace('_', '-')}"] = choices
    return found


def _bash(options: dict[str, dict[str, tuple[str, ...]]]) -> str:
    return f"""\
# Completion of cfb for bash.
_cfb() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" options="" choices=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "{" ".join(options)}" -- "$current"))
        return
    fi
    case "${{COMP_WORDS[1]}}" in
{_cases(options)}
    esac
    case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}}" in
{_choices(options)}
    esac
    if [ -n "$choices" ]; then
        COMPREPLY=($(compgen -W "$choices" -- "$current"))
    elif [[ "$current" == -* ]]; then
        COMPREPLY=($(compgen -W "$options" -- "$current"))
    else
        COMPREPLY=($(compgen -f -- "$current"))
    fi
}}
complete -o filenames -F _cfb cfb
"""


def _zsh(options: dict[str, dict[str, tuple[str, ...]]]) -> str:
    return f"""\
#compdef cfb
_cfb() {{
    local options="" choices=""
    if (( CURRENT == 2 )); then
        compadd -- {" ".join(options)}
        return
    fi
    case "$words[2]" in
{_cases(options)}
    esac
    case "$words[2] $words[CURRENT-1]" in
{_choices(options)}
    esac
    if [[ -n "$choices" ]]; then
        compadd -- ${{=choices}}
    elif [[ "$words[CURRENT]" == -* ]]; then
        compadd -- ${{=options}}
    else
        _files
    fi
}}
_cfb "$@"
"""


def _fish(options: dict[str, dict[str, tuple[str, ...]]]) -> str:
    lines = ["# Completion of cfb for fish."]
    for name, of in options.items():
        summary = COMMANDS[name].summary.replace("'", "\\'")
        lines.append(f"complete -c cfb -n __fish_use_subcommand -f -a {name} -d '{summary}'")
        for option, choices in of.items():
            chosen = f" -x -a '{' '.join(choices)}'" if choices else ""
            lines.append(f"complete -c cfb -n '__fish_seen_subcommand_from {name}' -l {option[2:]}{chosen}")
    return "\n".join(lines) + "\n"


def _cases(options: dict[str, dict[str, tuple[str, ...]]]) -> str:
    return "\n".join(f'        {name}) options="{" ".join(of)}" ;;' for name, of in options.items())


def _choices(options: dict[str, dict[str, tuple[str, ...]]]) -> str:
    return "\n".join(
        f'        "{name} {option}") choices="{" ".join(choices)}" ;;'
        for name, of in options.items()
        for option, choices in of.items()
        if choices
    )
