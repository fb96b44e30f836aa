"""A group's cases against its goldens."""

from __future__ import annotations

from tests.goldens import results
from tests.goldens.cases import Group


def differences(name: str, found: Group) -> tuple[list[str], str]:
    """What differs first in each case; and a word on how they were compared."""
    golden = results.read(name)
    here, made = results.fingerprint(), results.read("fingerprint")
    to_the_bit = here == made
    other = [one for one, is_now in found.inputs.items() if golden["inputs"].get(one) != is_now]
    if other and not to_the_bit:
        return [], f"skipped: on this machine {', '.join(other)} reads or renders as other bits"
    if other:
        return [f"{name}: another input, not another result: {', '.join(other)}"], "wrong input"
    lines = []
    cases = golden["cases"]
    for one, case in found.cases.items():
        if one not in cases:
            lines.append(f"{name}/{one}: no golden")
            continue
        was = results.Case.from_dict(cases[one])
        said = results.first_difference(was, case, to_the_bit=to_the_bit)
        if said is not None:
            lines.append(f"{name}/{one}: {said}")
    if found.only is None:
        lines += [f"{name}/{one}: not computed" for one in cases if one not in found.cases]
    how = "to the bit" if to_the_bit else (
        f"poses to {results.TOLERANCE}, hashes not at all: another machine "
        f"({', '.join(key for key in made if here.get(key) != made[key])})"
    )  # fmt: skip
    return lines, f"{len(found.cases) - len(lines)} of {len(found.cases)} cases equal, {how}"
