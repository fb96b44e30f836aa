"""How a verb's help looks: one screen, the words that are typed, and no names of types."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

# In an option's help: the names of all layouts, which only the help itself is worth importing for.
LAYOUTS = "LAYOUTS"
# Widest first column of a table; a longer one has its meaning on the next line.
_COLUMN = 27


class Verb(TyperCommand):
    """A verb whose help names the options that few drives need without explaining them."""

    # Where those are explained.
    _EXPLAINED = "Also for drives, explained by engram drive info --help"

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments in the line of usage."""
        del ctx
        arguments = [_typed(one) for one in self.params if one.param_type_name == "argument"]
        return [self.options_metavar or "", *arguments]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Tables of arguments and options, and the names of the options that are not explained."""
        arguments, options, others = [], [], []
        for one in self.get_params(ctx):
            if one.param_type_name == "argument":
                arguments.append((_typed(one), _meaning(one, ctx)))
            elif self._explains(one):
                options.append((one, ctx))
            else:
                others.append(one.opts[0])
        if arguments:
            with formatter.section("Arguments"):
                formatter.write_dl(arguments, col_max=_COLUMN)
        with formatter.section("Options"):
            formatter.write_dl([_record(*one) for one in options], col_max=_COLUMN)
        if others:
            with formatter.section(self._EXPLAINED):
                formatter.write_text(" ".join(others))

    def _explains(self, option: Any) -> bool:
        return not option.hidden


class VerbInFull(Verb):
    """A verb whose help explains those options, too."""

    def _explains(self, option: Any) -> bool:
        option.hidden = False
        return True


def _typed(argument: Any) -> str:
    """How an argument is typed: MAP, [REV], DRIVE..."""
    name = argument.metavar or argument.name.upper()
    many = "..." if argument.nargs != 1 else ""
    return f"{name}{many}" if argument.required else f"[{name}]{many}"


def _meaning(argument: Any, ctx: Any) -> str:
    return _record(argument, ctx)[1].removesuffix("[required]").rstrip()  # usage says so


def _record(parameter: Any, ctx: Any) -> tuple[str, str]:
    typed, meaning = parameter.get_help_record(ctx)
    if LAYOUTS in meaning:
        from engram.sequences import layout_names

        meaning = meaning.replace(LAYOUTS, ", ".join(layout_names()))
    return typed, " ".join(meaning.split()).replace("]. [", "; ")
