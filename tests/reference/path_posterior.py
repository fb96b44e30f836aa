"""[L15 §V] straight from the equations, in exact fractions: the oracle of the path policies."""

from fractions import Fraction


def posterior(paths, candidates, observed, outcomes, reference, alpha=1, gamma=1):
    """p(y = i | Z, θ, π) of each candidate as fractions that sum to 1.

    paths: sets of nodes; candidates Y, observed W: lists of nodes; outcomes z: list of bool.
    """
    prior = prior_of(paths, candidates, reference, gamma)
    joint = []
    for i, candidate in enumerate(candidates):
        likelihood = Fraction(1)
        if len(observed) > 1:
            theta = theta_row(paths, candidate, observed, alpha)
            for value, succeeded in zip(theta, outcomes, strict=True):
                likelihood *= value if succeeded else 1 - value
        joint.append(prior[i] * likelihood)
    total = sum(joint)
    return [value / total for value in joint]


def theta_row(paths, candidate, observed, alpha=1):
    """θ_ij over j (5): (Z_ij + α) / Σ_x (Z_ix + α)."""
    counts = [sum(1 for path in paths if candidate in path and w in path) for w in observed]
    total = sum(count + Fraction(alpha) for count in counts)
    return [(count + Fraction(alpha)) / total for count in counts]


def prior_of(paths, candidates, reference, gamma=1):
    """π over i: (N_ik + γ) / Σ_x (N_xk + γ); uniform without a reference."""
    if reference is None:
        return [Fraction(1, len(candidates))] * len(candidates)
    counts = [sum(1 for path in paths if c in path and reference in path) for c in candidates]
    total = sum(count + Fraction(gamma) for count in counts)
    return [(count + Fraction(gamma)) / total for count in counts]
