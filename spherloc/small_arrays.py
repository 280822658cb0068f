"""Loops over small arrays for kernels to share.

numba compiles such a loop many times faster than its own assignments to slices, copies and array expressions: each of
these is compiled anew in every kernel that has one, together with the texts of its error messages.

Small functions of numbers are not inlined by numba either (``inline="always"``), which compiles each anew where it is
called; LLVM does that by itself. Only where the search over pairs became measurably slower, they are.
"""

import numpy as np

from spherloc.kernel_cache import kernel


@kernel()
def copy_vector(source, target):
    """Write the vector ``source`` (N,) to ``target`` (N,)."""
    for k in range(len(target)):
        target[k] = source[k]


@kernel()
def copy_matrix(source, target):
    """Write the matrix ``source`` (N, K) to ``target`` (N, K)."""
    for a in range(target.shape[0]):
        for b in range(target.shape[1]):
            target[a, b] = source[a, b]


@kernel()
def fill_vector(target, value):
    """Write the number ``value`` to all of ``target`` (N,)."""
    for k in range(len(target)):
        target[k] = value


@kernel()
def fill_matrix(target, value):
    """Write the number ``value`` to all of ``target`` (N, K)."""
    for a in range(target.shape[0]):
        for b in range(target.shape[1]):
            target[a, b] = value


@kernel()
def rotation_of(cam_from_map):
    """A copy of the rotation (3, 3) of the pose ``cam_from_map`` (3, 4)."""
    rotation = np.empty((3, 3))
    copy_matrix(cam_from_map, rotation)
    return rotation


@kernel()
def translation_of(cam_from_map):
    """A copy of the translation (3,), m, of the pose ``cam_from_map`` (3, 4)."""
    translation = np.empty(3)
    for k in range(3):
        translation[k] = cam_from_map[k, 3]
    return translation


@kernel()
def write_pose(rotation, translation, cam_from_map):
    """Write a rotation (3, 3) and a translation (3,), m, to the pose ``cam_from_map`` (3, 4)."""
    for a in range(3):
        for b in range(3):
            cam_from_map[a, b] = rotation[a, b]
        cam_from_map[a, 3] = translation[a]


@kernel()
def moved_point(rotation, translation, point):
    """R p + t (3,), m, of a rotation (3, 3), a translation (3,), m, and a point (3,), m."""
    moved = rotation @ point
    for k in range(3):
        moved[k] += translation[k]
    return moved


@kernel()
def write_translation_to(middle, rotation, centre, translation):
    """Write the ``translation`` (3,), m, with which a ``rotation`` (3, 3) takes ``centre`` to ``middle`` (3,), m."""
    turned = rotation @ centre
    for k in range(3):
        translation[k] = middle[k] - turned[k]


@kernel()
def mark_within(errors, limits, mask):
    """Write which of ``errors`` (N,) are within their ``limits`` (N,) to ``mask`` (N,); returns how many."""
    count = 0
    for k in range(len(errors)):
        mask[k] = errors[k] <= limits[k]
        count += mask[k]
    return count


@kernel()
def sum_of_squares(errors, mask):
    """Sum of the squares of those of ``errors`` (N,) that ``mask`` (N,) is true for."""
    total = 0.0
    for k in range(len(errors)):
        if mask[k]:
            total += errors[k] * errors[k]
    return total


@kernel()
def count_true(mask):
    """How many of ``mask`` (N,) are true."""
    count = 0
    for k in range(len(mask)):
        count += mask[k]
    return count


@kernel()
def equal(a, b):
    """Whether the vectors ``a`` and ``b`` (N,) are equal in all elements."""
    same = True
    for k in range(len(a)):
        same = same and a[k] == b[k]
    return same


@kernel()
def elements(values, indices):
    """``values[indices]`` (K,) of whole numbers (N,)."""
    taken = np.empty(len(indices), np.int64)
    for k in range(len(indices)):
        taken[k] = values[indices[k]]
    return taken


@kernel()
def indices_of_true(mask):
    """Indices (K,) at which ``mask`` (N,) is true."""
    indices, found = np.empty(len(mask), np.int64), 0
    for k in range(len(mask)):
        indices[found] = k
        found += mask[k]
    return indices[:found]


MAX_INSERTED = 20
"""Fewer numbers are sorted by insertion."""


@kernel()
def _insert(values, low, high):
    """Sort ``values`` (N,) from index ``low`` to ``high`` by insertion."""
    for k in range(low + 1, high + 1):
        value, at = values[k], k
        while at > low and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


@kernel()
def sort_between(values, first, last):
    """Sort ``values`` (N,) without NaN from index ``first`` to ``last``, by quicksort if they are many."""
    if last - first < MAX_INSERTED:
        _insert(values, first, last)
    else:
        _sort_many(values, first, last)


@kernel()
def _sort_many(values, first, last):
    """Sort ``values`` (N,) without NaN from index ``first`` to ``last`` by quicksort."""
    waiting, count = np.empty((64, 2), np.int64), 1
    waiting[0, 0], waiting[0, 1] = first, last
    while count > 0:
        count -= 1
        low, high = waiting[count, 0], waiting[count, 1]
        while high - low >= MAX_INSERTED:
            a, b, c = values[low], values[(low + high) >> 1], values[high]
            pivot = max(min(a, b), min(max(a, b), c))
            i, j = low, high
            while i <= j:
                while values[i] < pivot:
                    i += 1
                while pivot < values[j]:
                    j -= 1
                if i <= j:
                    values[i], values[j] = values[j], values[i]
                    i, j = i + 1, j - 1
            # The longer part waits, so that those that do are at most the logarithm of the count.
            if j - low > high - i:
                waiting[count, 0], waiting[count, 1] = low, j
                low = i
            else:
                waiting[count, 0], waiting[count, 1] = i, high
                high = j
            count += 1
        _insert(values, low, high)
