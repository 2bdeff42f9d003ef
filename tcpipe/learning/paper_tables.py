"""The paper's own results (Eder and Steinbauer-Wagner, section V), to stand beside a dataset's: tables I to V."""

from __future__ import annotations

CLASSES = ("grass", "mud", "unpaved road", "paved road", "all")
"""Columns of `BY_CLASS`."""

BY_CLASS = {
    ("test", "w", "rmse"): (14.35, 13.92, 7.81, 16.09, 14.04),
    ("test", "w", "mape_percent"): (9.96, 7.51, 5.74, 11.53, 9.39),
    ("test", "v", "rmse"): (0.04, 0.05, 0.02, 0.05, 0.04),
    ("test", "v", "mape_percent"): (3.32, 5.27, 1.78, 3.64, 3.41),
    ("test", "T", "rmse"): (0.06, 0.10, 0.03, 0.07, 0.06),
    ("test", "T", "mape_percent"): (3.26, 5.50, 1.74, 3.52, 3.37),
    ("test", "E", "rmse"): (18.22, 29.26, 10.98, 25.55, 21.51),
    ("test", "E", "mape_percent"): (11.06, 10.64, 6.15, 12.90, 10.77),
    ("unseen", "w", "rmse"): (18.85, 29.20, 15.07, 16.15, 17.73),
    ("unseen", "w", "mape_percent"): (11.29, 19.25, 8.42, 11.58, 10.74),
    ("unseen", "v", "rmse"): (0.07, 0.06, 0.04, 0.07, 0.06),
    ("unseen", "v", "mape_percent"): (5.60, 5.22, 2.90, 5.70, 5.14),
    ("unseen", "T", "rmse"): (0.09, 0.09, 0.04, 0.09, 0.08),
    ("unseen", "T", "mape_percent"): (5.74, 5.18, 2.91, 5.67, 5.04),
    ("unseen", "E", "rmse"): (27.50, 49.58, 19.24, 22.69, 26.63),
    ("unseen", "E", "mape_percent"): (13.04, 22.46, 10.12, 13.69, 12.80),
}
"""Tables I and II: split (the paper's validation is ``unseen``), quantity, measure, to a value a class."""

ABLATION = {
    ("O", "C", "H"): ((14.04, 9.39, 0.04, 3.41, 21.51, 10.77, 0.06, 3.37), (17.73, 10.74, 0.06, 5.14, 26.63, 12.80, 0.08, 5.04)),
    ("C", "H"): ((19.33, 10.94, 0.05, 3.84, 30.35, 12.29, 0.08, 3.71), (19.00, 12.49, 0.06, 5.05, 27.59, 14.53, 0.08, 5.18)),
    ("O", "H"): ((14.78, 9.86, 0.04, 3.62, 22.17, 10.92, 0.06, 3.63), (22.39, 13.82, 0.07, 6.25, 34.95, 17.38, 0.10, 6.54)),
    ("O", "C"): ((50.63, 41.02, 0.07, 5.69, 67.59, 47.84, 0.09, 5.64), (55.63, 45.07, 0.08, 7.22, 73.75, 52.20, 0.11, 7.57)),
    ("O",): ((54.52, 44.63, 0.09, 6.49, 57.34, 57.17, 0.11, 6.41), (61.77, 50.24, 0.09, 8.10, 87.39, 60.39, 0.13, 8.68)),
    ("C",): ((66.37, 44.10, 0.07, 5.73, 91.93, 47.16, 0.11, 5.32), (61.49, 37.11, 0.07, 5.92, 79.83, 40.07, 0.10, 5.98)),
    ("H",): ((19.33, 11.69, 0.05, 3.71, 28.67, 13.31, 0.07, 3.60), (22.52, 15.17, 0.07, 5.53, 32.09, 17.36, 0.09, 5.64)),
}  # fmt: skip
"""Table III: layers that are left, to RMSE and MAPE of w, v, E, T on test and on unseen."""

ABLATION_COLUMNS = tuple((quantity, measure) for quantity in "wvET" for measure in ("rmse", "mape_percent"))

ENERGY = {
    "ours": ((21.51, 10.77), (26.63, 12.80)),
    "Wei & Isler, grass only": ((51.39, 27.25), (56.16, 28.37)),
    "Wei & Isler, a net per class": ((34.52, 14.64), (32.92, 16.96)),
}
"""Table IV: RMSE [J] and MAPE [%] of E on test and on unseen."""

TIME = {"ours": ((0.06, 3.37), (0.08, 5.04)), "expected time": ((0.22, 17.45), (0.17, 13.82))}
"""Table V: RMSE [s] and MAPE [%] of T on test and on unseen."""
