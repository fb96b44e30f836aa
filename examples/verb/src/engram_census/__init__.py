"""A verb: how many nodes each robot saved."""

import json
from collections import Counter

import typer

import engram
from engram.cli import options


def census(path: options.MapPath, *, as_json: options.Json = False) -> None:
    r"""Count the nodes that each robot saved.

    \b
    Examples:
      engram census town.engram
    """
    with engram.open_map(path) as opened:
        graph, sessions = opened.graph, opened.sessions
        robots = Counter(sessions[graph.node(row).session].robot for row in range(len(graph)))
    if as_json:
        typer.echo(json.dumps(robots))
    else:
        for robot, nodes in robots.most_common():
            typer.echo(f"{robot}: {nodes} nodes")
