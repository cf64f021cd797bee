"""Best-scoring partition of one frame's detections into people; see `grouping`."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.compilation import helper
from pipelines.keypoints.grouping_rays import Nodes, put_into_group, size_of_group
from pipelines.keypoints.grouping_tracks import Tracks

_KNOWN = 1.0  # each side of a pair that continues the track adds this; 8 locked wrong starts in for good
_LOYAL = 14.0  # on top, for leaving company for none: a known detection is refused beyond 5 sigma
_STAY = 4.0  # score of continuing a track for a detection that is alone in its group
_SURE = 0.3  # likeness 0..1 with a track's last picture above which the detection is a known person


@helper
def begin_groups(nodes: Nodes, n: int, slots: int) -> None:
    """Start from the pictures: each detection goes to the track it continues best, or stands alone."""
    nodes.member[:] = -1
    for a in range(n):
        best = -1
        for k in range(slots):
            if nodes.known[a, k] > 0.0 and (best < 0 or nodes.known[a, k] > nodes.known[a, best]):
                best = k
        if best < 0:
            put_into_group(nodes, a, slots + a)
            continue
        rival = nodes.member[best, nodes.camera[a]]
        if rival >= 0 and nodes.known[rival, best] >= nodes.known[a, best]:
            put_into_group(nodes, a, slots + a)
            continue
        if rival >= 0:
            put_into_group(nodes, rival, slots + rival)
        put_into_group(nodes, a, best)


@helper
def _affinity(nodes: Nodes, one: int, two: int) -> float:
    """Compute the mean weight between two groups; -inf if they share a camera, 0 without comparable pairs."""
    total: float = 0.0
    pairs = 0
    for c in range(nodes.member.shape[1]):
        a = nodes.member[one, c]
        if a < 0:
            continue
        if nodes.member[two, c] >= 0:
            return -np.inf
        for other in range(nodes.member.shape[1]):
            b = nodes.member[two, other]
            if b >= 0 and nodes.weight[a, b] != 0.0:
                total += nodes.weight[a, b]
                pairs += 1
    return total / pairs if pairs else 0.0


@helper
def join_groups(nodes: Nodes, n: int, tracks: Tracks) -> None:
    """Join groups that agree, best first, until none does; joined tracks become the one seen more."""
    slots = len(tracks.identity)
    while True:
        best, stay, leave = 0.0, -1, -1
        for two in range(slots + n):
            if size_of_group(nodes, two) == 0:
                continue
            for one in range(two):
                if size_of_group(nodes, one) == 0 or (two < slots and tracks.apart[one, two]):
                    continue
                affinity = _affinity(nodes, one, two)
                if affinity > best:
                    best, stay, leave = affinity, one, two
        if stay < 0:
            return
        if leave < slots and tracks.views[leave] > tracks.views[stay]:
            stay, leave = leave, stay
        for c in range(nodes.member.shape[1]):
            if nodes.member[leave, c] >= 0:
                put_into_group(nodes, nodes.member[leave, c], stay)
                nodes.member[leave, c] = -1
        if leave < slots:
            for a in range(n):
                nodes.known[a, stay] = max(nodes.known[a, stay], nodes.known[a, leave])
                nodes.known[a, leave] = 0.0
            tracks.identity[leave] = -1


@helper
def bind_known(nodes: Nodes, n: int, tracks: Tracks) -> None:
    """Compute the bond of each detection to each track: continuity minus that of the best other track.

    If a detection continues a person who was once seen beside the track in one picture, it is not assigned
    to the track (the actor disappears behind a tree and the bystander stays), unless the two exchange places.
    """
    slots = len(tracks.identity)
    for a in range(n):
        first, second = -1, -1
        for k in range(slots):
            if nodes.known[a, k] > 0.0:
                if first < 0 or nodes.known[a, k] > nodes.known[a, first]:
                    first, second = k, first
                elif second < 0 or nodes.known[a, k] > nodes.known[a, second]:
                    second = k
        best = nodes.known[a, first] if first >= 0 else 0.0
        next_best = nodes.known[a, second] if second >= 0 else 0.0
        for k in range(slots, slots + n):
            nodes.bond[a, k] = -best
        for k in range(slots):
            if k == first:
                nodes.bond[a, k] = best - next_best
            else:
                nodes.bond[a, k] = nodes.known[a, k] - best
            nodes.barred[a, k] = best > _SURE and k != first and tracks.apart[first, k]


@helper
def _gain(nodes: Nodes, a: int, label: int) -> float:
    """Compute a detection's contribution to a group's score; ignore others of its own camera in the group."""
    bond = float(nodes.bond[a, label])
    total = _STAY * bond
    for c in range(nodes.member.shape[1]):
        b = nodes.member[label, c]
        if c != nodes.camera[a] and b >= 0:
            total += nodes.weight[a, b] + _KNOWN * (bond + nodes.bond[b, label])
    return total


@helper
def settle_nodes(nodes: Nodes, n: int, slots: int) -> None:
    """Move and exchange detections while the score of the partition rises."""
    labels = slots + n
    for _ in range(100):
        changed = False
        for a in range(n):
            here, c = nodes.label[a], nodes.camera[a]
            own = _gain(nodes, a, here)
            best, target, exchange = 1e-9, -1, False
            empty_tried = False
            for label in range(labels):
                if label == here:
                    continue
                empty = size_of_group(nodes, label) == 0
                if empty and label < slots and nodes.known[a, label] == 0.0:
                    continue
                if empty and label >= slots:
                    if empty_tried:
                        continue
                    empty_tried = True
                gain = _gain(nodes, a, label) - own
                rival = nodes.member[label, c]
                if empty and label >= slots:
                    mates = max(0, size_of_group(nodes, here) - 1)
                    gain -= _LOYAL * mates * nodes.known[a, here] if here < slots else 0.0
                barred = label < slots and nodes.barred[a, label]
                if rival < 0:
                    if gain > best and not barred:
                        best, target, exchange = gain, label, False
                    continue
                gain -= _gain(nodes, rival, label)
                swapped = gain + _gain(nodes, rival, here)
                if swapped > best:
                    best, target, exchange = swapped, label, True
                evicted = gain + _STAY * nodes.bond[rival, labels - 1]
                if evicted > best and not barred:
                    best, target, exchange = evicted, label, False
            if target < 0:
                continue
            changed = True
            rival = nodes.member[target, c]
            nodes.member[here, c] = -1
            put_into_group(nodes, a, target)
            if rival >= 0:
                put_into_group(nodes, rival, here if exchange else _empty_label(nodes, slots, labels))
        if not changed:
            return


@helper
def _empty_label(nodes: Nodes, slots: int, labels: int) -> int:
    for label in range(slots, labels):
        if size_of_group(nodes, label) == 0:
            return label
    return labels - 1  # never reached: an evicted node leaves fewer than N others for N labels
