"""Numbers of A. Filotheou's thesis, chapter 6, and of its program: to print beside ours.

The thesis shows most of them as bars and boxes; they were read off the vector figures,
so the last digit is the quantum of the drawing. Pairs are median/mean. The columns are
σ_R = .01, .03, .05, .10, .20 m, first for σ_M = 0, then for σ_M = .05 m. Every bar is
of 454 020 matches: the 45 402 scans of five recordings, ten times each.
"""

SIGMAS_R = (0.01, 0.03, 0.05, 0.10, 0.20)
SIGMAS_M = (0.0, 0.05)
CELLS = tuple((sigma_R, sigma_M) for sigma_M in SIGMAS_M for sigma_R in SIGMAS_R)

# §6.5: scans in each recording, which weigh the sets in all tables of the thesis.
SCANS = {
    "aces": 7373,
    "freiburg_079": 4933,
    "intel": 13630,
    "mit_csail": 1987,
    "mit_killian": 17479,
}

METHODS = {
    "fm": "fourier_mellin",
    "uf": "procrustes",
    "x1": "first_principles",
}
"""The thesis's names of the methods, and ours."""


def _cells(text: str) -> dict[tuple[float, float], tuple[float, ...]]:
    """Ten columns of numbers, or of numbers joined by slashes, by (σ_R, σ_M)."""
    columns = [tuple(float(v) for v in word.split("/")) for word in text.split()]
    return dict(zip(CELLS, columns, strict=True))


# Fig. 6.23 [%], ±.03.
SUCCESS = {
    "x1": _cells("99.92 99.90 99.82 99.42 98.56 97.80 97.85 97.85 97.82 97.52"),
    "uf": _cells("100.0 99.97 99.97 99.92 99.77 99.37 99.42 99.42 99.39 99.22"),
    "fm": _cells("100.0 99.97 99.97 99.92 99.75 99.39 99.42 99.44 99.39 99.22"),
}

# Appendix ΣΤ.2 [mm].
POSITION = {
    "x1": _cells(
        "2.28/11.1 6.08/16.5 9.82/22.0 19.8/36.9 46.2/65.0 "
        "42.7/64.7 43.1/64.7 43.9/65.4 47.4/69.0 61.2/79.9"
    ),
    "uf": _cells(
        "2.15/11.1 4.88/13.8 7.41/16.8 13.9/25.7 30.8/45.7 "
        "33.1/48.6 33.1/48.3 33.9/49.0 37.0/52.3 48.0/63.0"
    ),
    "fm": _cells(
        "2.15/11.1 4.94/13.9 7.47/16.8 13.9/25.7 30.9/45.8 "
        "33.0/48.5 33.4/48.4 34.0/49.0 37.2/52.5 48.2/63.1"
    ),
}

# Appendix ΣΤ.2 [mrad].
ORIENTATION = {
    "x1": _cells(
        "0.16/1.11 0.31/2.93 0.46/5.09 0.94/11.4 3.42/25.7 "
        "3.54/12.5 3.70/13.2 3.89/14.4 4.65/20.2 7.50/33.3"
    ),
    "uf": _cells(
        "0.16/0.22 0.20/0.99 0.25/1.33 0.39/2.23 0.77/3.98 "
        "1.88/5.98 1.88/6.17 1.90/6.13 1.94/6.87 2.10/7.90"
    ),
    "fm": _cells(
        "0.16/0.22 0.21/0.92 0.25/1.48 0.39/2.22 0.77/4.15 "
        "1.89/5.93 1.89/5.98 1.91/6.12 1.94/6.63 2.10/7.75"
    ),
}

# Fig. 6.27: virtual scans a match; the thesis does not say how it counts.
VIRTUAL_SCANS = {
    "x1": _cells(
        "353/748 334/522 324/451 303/379 279/351 "
        "305/1003 305/860 298/725 286/511 267/390"
    ),
    "uf": _cells(
        "247/247 245/252 247/254 249/259 262/276 "
        "262/335 262/321 262/307 262/298 263/301"
    ),
    "fm": _cells(
        "247/247 245/252 247/254 249/259 262/276 "
        "262/334 262/317 262/306 262/297 264/302"
    ),
}

# Total ms with ray casting in polygons, one thread at 4.0 GHz (fig. 6.26 and after).
MILLISECONDS = {
    "x1": _cells(
        "95.3/202 92.0/145 89.2/126 83.5/106 77.6/97.9 "
        "91.3/297 91.6/259 90.1/219 86.8/155 82.8/119"
    ),
    "uf": _cells(
        "95.1/98.7 94.9/97.7 94.6/97.5 95.1/98.9 96.5/106 "
        "103/135 103/130 103/125 105/122 107/125"
    ),
    "fm": _cells(
        "80.2/82.3 80.0/82.8 80.2/83.0 80.4/84.2 82.6/90.9 "
        "88.5/117 89.7/112 90.1/108 90.4/106 93.0/108"
    ),
}

# The same program on 195 laserazos cases, 2 virtual cores, CPU ms per match of one
# thread (../shared/golden/peers.md): median and mean. Measured on another day and
# another machine of the kind that ours are measured on.
PROGRAM_MILLISECONDS = {
    ("fm", 0.01, 0.0): (114, 125),
    ("fm", 0.05, 0.0): (130, 142),
    ("fm", 0.10, 0.0): (134, 149),
    ("fm", 0.05, 0.05): (162, 203),
    ("x1", 0.05, 0.0): (148, 193),
    ("x1", 0.05, 0.05): (154, 210),
}

# §6.2: rotation by x1 alone, true position, laserazos × 100, Δθ in ±π: mean absolute
# error [mrad] at σ_R = .01, .03, .05, .10 and σ_M = 0. With σ_M = .05 it is 26 to 27
# at N_s = 360 and 26 at 2880, whatever σ_R.
X1_SIGMAS = (0.01, 0.03, 0.05, 0.10)
X1_ROTATION = {
    360: (2.9, 4.1, 5.1, 8.0),
    720: (1.6, 2.3, 3.1, 5.4),
    1440: (0.9, 1.4, 2.0, 3.6),
    2880: (0.5, 0.9, 1.3, 2.5),
}
X1_ROTATION_ON_CORRUPTED_MAP = {
    360: (26.5, 26.0, 26.1, 26.8),
    2880: (25.8, 25.8, 25.8, 25.9),
}

# Not the thesis, which says always (eq. 4.28): how often orientation was within
# γ/2^(1+ν) in an independent check on 150 star rooms (erratum E5) [%], ν = 0..3.
WITHIN_BOUND = (91, 91, 95, 97)

# §6.2: position law alone from (4, −4) to (.83, −.98), N_s = 360, heading known: final
# error [m] without noise and with σ = .05 m in both scans, in doubles.
POSITION_ALONE = {0.0: 2.04e-7, 0.05: 5.72e-3}

# §6.3: uf on laserazos × 100 without noise, ν_min = 0, by ν_max = 0..6.
DEGREES_POSITION = (155.0, 61.0, 14.2, 3.3, 1.0, 0.58, 0.36)  # mean [mm]
DEGREES_ORIENTATION = (24.5, 13.3, 2.96, 0.89, 0.49, 0.33, 0.22)  # mean [mrad]
DEGREES_MILLISECONDS = (6.8, 14.5, 29.0, 50.0, 75.0, 91.0, 121.0)  # mean, total
