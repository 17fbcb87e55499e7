"""Targets of the band bank: what is wanted of every tile now, and what of it the sensors will show."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel, late
from hapticrender.compiled.lanes import high, total
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs, read
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import SLOWEST
from hapticrender.control.kernels import TURN


@kernel
def derivative(band, t, re, im):
    """Envelope of the time derivative: j w times that of a tile's carriers."""
    omega = lanes(band, t, row.OMEGA)
    return -omega * im, omega * re


@kernel
def shown_pass(numbers, band, track, t, re, im):
    """What the sensor shows of a wanted envelope of a tile: before the contact's lag, and late."""
    omega = lanes(band, t, row.OMEGA)
    lag = numbers.foresight / high(read(track, row.SPEED), SLOWEST * numbers.typical_speed) * omega
    cos, sin = unit(-numbers.late / TURN * omega)
    re, im = re - lag * im, im + lag * re
    return re * cos - im * sin, re * sin + im * cos


@kernel
def told_pass(numbers, band, track, t, re, im):
    """What is wanted of a tile where the sensor shows re + j im: the inverse of `shown_pass`."""
    omega = lanes(band, t, row.OMEGA)
    lag = numbers.foresight / high(read(track, row.SPEED), SLOWEST * numbers.typical_speed) * omega
    cos, sin = unit(numbers.late / TURN * omega)
    re, im = re * cos - im * sin, re * sin + im * cos
    share = 1.0 / (1.0 + lag * lag)
    return share * (re + lag * im), share * (im - lag * re)


@kernel
def set_target(numbers, band, t, re, im):
    """Put the target R of a tile, its slope, and R as the observer sees it."""
    put(band, t, row.DR_RE, numbers.rate * (re - lanes(band, t, row.R_RE)))
    put(band, t, row.DR_IM, numbers.rate * (im - lanes(band, t, row.R_IM)))
    put(band, t, row.R_RE, re)
    put(band, t, row.R_IM, im)
    if numbers.error_observer:
        put(band, t, row.SEEN_RE, re)
        put(band, t, row.SEEN_IM, im)
    else:
        pole = 0.5 * numbers.reference
        seen_re, seen_im = lanes(band, t, row.SEEN_RE), lanes(band, t, row.SEEN_IM)
        put(band, t, row.SEEN_RE, seen_re + pole * (re - seen_re))
        put(band, t, row.SEEN_IM, seen_im + pole * (im - seen_im))


@kernel
def given_pass(numbers, band, t, wanted):
    """Wanted envelope of a tile that is constant, or times `wanted`."""
    weight = lanes(band, t, row.WEIGHT)
    if numbers.modulated:
        weight = weight * wanted
    return weight * lanes(band, t, row.WANTED_RE), weight * lanes(band, t, row.WANTED_IM)


@kernel
def analysed_pass(tables, state, t, g, residual):
    """Wanted envelope of a tile as the analysis of a waveform finds it by its `residual`; and as it is told."""
    numbers, band = tables.numbers, state.band
    raw_re = lanes(band, t, row.RAW_RE) + g * residual * lanes(band, t, row.COS)
    raw_im = lanes(band, t, row.RAW_IM) - g * residual * lanes(band, t, row.SIN)
    put(band, t, row.RAW_RE, raw_re)
    put(band, t, row.RAW_IM, raw_im)
    if numbers.differentiated:
        raw_re, raw_im = derivative(band, t, raw_re, raw_im)
    if numbers.shows:
        raw_re, raw_im = shown_pass(numbers, band, state.track, t, raw_re, raw_im)
    follow, weight = 0.5 * g, lanes(band, t, row.WEIGHT)
    old_re, old_im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
    re, im = old_re + follow * (weight * raw_re - old_re), old_im + follow * (weight * raw_im - old_im)
    told_re, told_im = re, im
    if numbers.shows:
        told_re, told_im = told_pass(numbers, band, state.track, t, re, im)
    return re, im, told_re, told_im


@kernel
def wanted_residual(band, wanted):
    """What the analysis of the target has not explained of the wanted waveform."""
    explained = 0.0 * wanted
    for t in range(band.shape[0]):
        shown = lanes(band, t, row.RAW_RE) * lanes(band, t, row.COS)
        explained += total(wanted, shown - lanes(band, t, row.RAW_IM) * lanes(band, t, row.SIN))
    return wanted - explained


@late
def found_targets(tables, state, g, wanted, target):
    """Targets that a waveform holds, or that sensors show as something else."""
    numbers, band, residual = tables.numbers, state.band, wanted
    if numbers.analysed:
        residual = wanted_residual(band, wanted)
    for t in range(band.shape[0]):
        if state.pace[t] == row.STEADY:
            put_pairs(target, t, lanes(band, t, row.R_RE), lanes(band, t, row.R_IM))
            continue
        if numbers.analysed:
            re, im, told_re, told_im = analysed_pass(tables, state, t, g, residual)
        else:
            re, im = given_pass(numbers, band, t, wanted)
            if numbers.differentiated:
                re, im = derivative(band, t, re, im)
            told_re, told_im = re, im
            if numbers.shows:
                re, im = shown_pass(numbers, band, state.track, t, re, im)
        put_pairs(target, t, told_re, told_im)
        set_target(numbers, band, t, re, im)


@kernel
def target_all(tables, state, g, wanted, target):
    """Wanted envelope R of every tile and its slope: constant, times `wanted`, or what that holds."""
    numbers, band = tables.numbers, state.band
    if numbers.analysed or numbers.differentiated or numbers.shows:
        found_targets(tables, state, g, wanted, target)
        return
    for t in range(band.shape[0]):
        if state.pace[t] != row.STEADY:
            re, im = given_pass(numbers, band, t, wanted)
            set_target(numbers, band, t, re, im)
        put_pairs(target, t, lanes(band, t, row.R_RE), lanes(band, t, row.R_IM))
