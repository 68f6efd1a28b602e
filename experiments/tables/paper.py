"""What the paper reports: Tables 1, 2, 3, 4 and 6 of AnyTouch (ICLR 2025).

Accuracies in %, errors in g.
"""

from __future__ import annotations

Row = tuple[float | None, ...]

# Columns: TAG material, Feel grasp, OF 1.0 material, OF 2.0 material.
TABLE1: dict[str, Row] = {
    "no_pretraining": (52.96, 72.37, 41.00, 73.16),  # CLIP
    "gelsight": (83.55, 79.12, 46.12, 75.10),
    "gelsight+gelslim": (79.67, 79.28, 47.55, 75.53),
    "gelsight+gelslim+digit": (79.61, 79.10, 48.00, 75.57),
    "gelsight+gelslim+digit+gelsight_mini": (79.70, 79.40, 48.75, 75.66),
}
# Table 4, pouring: mean error with the encoder fine-tuned and frozen; less is better.
TABLE4: dict[str, Row] = {
    "none": (5.22, 49.1),
    "t3": (2.33, 9.74),
    "static": (2.45, 9.60),
    "anytouch": (1.56, 8.22),
}
# Table 6; columns of Table 1.
TABLE6: dict[str, Row] = {
    "anytouch": (80.82, 80.53, 49.62, 76.02),
    "no_text": (75.91, 78.93, 48.87, 75.52),
    "no_vision": (74.55, 77.30, 48.12, 75.22),
    "no_text_aligned": (80.70, 80.19, 49.21, 75.91),
    "no_stage1": (78.34, 78.62, 48.75, 76.08),
    "no_stage2": (68.64, 72.39, 46.50, 73.09),
    "no_matching": (80.54, 79.43, 49.25, 75.80),
    "no_dynamic": (77.93, 79.28, 48.62, 75.70),
    "no_universal": (80.79, 79.03, 48.40, 75.40),
}
