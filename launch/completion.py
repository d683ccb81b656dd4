"""The command `sparseskin completion`: a script that teaches a shell what words may follow.

The script holds the tree of commands and options; names of nodes, topics and settings are those
of the graph that runs as the key is pressed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any

from .command_tree import whole_tree

_BASH = r"""# Completion of sparseskin for bash. In ~/.bashrc: source <(sparseskin completion bash)
_sparseskin_tree='@TREE@'
_sparseskin_paths() {
    local path
    compopt -o filenames 2> /dev/null
    while IFS= read -r path; do
        COMPREPLY+=("$path")
    done < <(compgen "$1" -- "$2")
}
_sparseskin() {
    local word
    COMPREPLY=()
    while IFS= read -r word; do
        case $word in
            :files) _sparseskin_paths -f "$2" ;;
            :folders) _sparseskin_paths -d "$2" ;;
            *[.=]) COMPREPLY+=("$word"); compopt -o nospace 2> /dev/null ;;
            *) COMPREPLY+=("$word") ;;
        esac
    done < <("${1/#\~/$HOME}" __complete "${COMP_WORDS[@]:1:COMP_CWORD}" \
        <<< "$_sparseskin_tree" 2> /dev/null)
}
complete -F _sparseskin sparseskin
"""
_ZSH = r"""#compdef sparseskin
# Completion of sparseskin for zsh. In ~/.zshrc, after compinit: source <(sparseskin completion zsh)
_sparseskin_tree='@TREE@'
_sparseskin() {
    local word
    local -a found begun
    while IFS= read -r word; do
        case $word in
            :files) _files ;;
            :folders) _files -/ ;;
            *[.=]) begun+=("$word") ;;
            *) found+=("$word") ;;
        esac
    done < <("${(Q)words[1]/#\~/$HOME}" __complete "${(@)words[2,CURRENT]}" \
        <<< "$_sparseskin_tree" 2> /dev/null)
    compadd -a found
    compadd -S '' -a begun
}
if [[ $funcstack[1] == _sparseskin ]]; then
    _sparseskin "$@"
else
    compdef _sparseskin sparseskin
fi
"""
_FISH = r"""# Completion of sparseskin for fish. In config.fish: sparseskin completion fish | source
set -g __sparseskin_tree '@TREE@'
function __sparseskin_words
    set -l words (commandline -opc) (commandline -ct)
    printf '%s' $__sparseskin_tree | sparseskin __complete $words[2..-1] 2>/dev/null |
    while read -l word
        switch $word
            case :files
                __fish_complete_path (commandline -ct)
            case :folders
                __fish_complete_directories (commandline -ct) ''
            case '*'
                echo $word
        end
    end
end
complete -c sparseskin -f -a '(__sparseskin_words)'
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


def add_completion_parser(
    commands: Any, whole: argparse.ArgumentParser, words: Mapping[str, Sequence[str]]
) -> None:
    """Add `completion` to the commands of the whole command line; `words` as in `whole_tree`."""
    parser = commands.add_parser(
        "completion",
        help="print a script that completes words in a shell",
        description="Print a script with which a shell completes commands, options, launch files\n"
        "and the settings of their nodes, studies, and the nodes, topics and settings of\n"
        "the running graph.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="bash: add to ~/.bashrc       source <(sparseskin completion bash)\n"
        "zsh:  add to ~/.zshrc        source <(sparseskin completion zsh)\n"
        "fish: add to config.fish     sparseskin completion fish | source",
    )
    parser.add_argument("shell", choices=tuple(SCRIPTS), help="which shell")
    parser.set_defaults(run=lambda arguments: _print(arguments.shell, whole_tree(whole, words)))


def _print(shell: str, whole: dict[str, Any]) -> int:
    tree = json.dumps(whole, separators=(",", ":")).replace("'", "\\u0027")
    print(SCRIPTS[shell].replace("@TREE@", tree), end="")
    return 0
