"""What is proven about a run, in words."""

from spherloc.trace import Certificate

KNOWABLE = 0.01
"""From this NFA on, the answer cannot be known."""
UNKNOWABLE = "the answer cannot be known"


def proof(certificate: Certificate) -> str:
    """Whether a better pose may exist, as part of a sentence."""
    lower, gap = certificate.lower_bound, certificate.gap
    if certificate.proven:
        return f"proven optimal: no pose explains more than {lower}"
    return f"not proven optimal: no pose explains more than {certificate.upper_bound}, so at most {gap} more"


def is_knowable(certificate: Certificate) -> bool:
    """Whether wrong matches are unlikely to agree as well as the inliers do."""
    return certificate.nfa < KNOWABLE


def chance(certificate: Certificate) -> str:
    """How many sets of wrong matches of that size agree by chance, as a number to read."""
    value = certificate.nfa
    return f"{value:.2g}" if value >= 1e-99 else "below 1e-99"


def warning(certificate: Certificate) -> str:
    """A sentence if no method can know the answer; empty otherwise."""
    if is_knowable(certificate):
        return ""
    return (
        f"{UNKNOWABLE.capitalize()}: {chance(certificate)} sets of {certificate.lower_bound} wrong matches are "
        "expected to agree with some pose by chance."
    )
