"""The picture of the autoencoder's training."""

from mavfi_cli.report.detectors import draw_loss_curve
from mavfi_cli.report.drawing import write_figure

CURVE = [[0, 0.2, 0.4], [20, 0.1, 0.3], [40, 0.05, 0.25]]


def test_the_curves_are_called_what_they_are(tmp_path):
    """A mean over vectors beside the largest of others: their heights are not to be compared."""
    (axes,) = draw_loss_curve(CURVE).axes
    drawn = {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
    assert drawn == {
        "training, mean": [[0, 0.2], [20, 0.1], [40, 0.05]],
        "validation, largest": [[0, 0.4], [20, 0.3], [40, 0.25]],
    }
    for name in ("a.svg", "b.svg"):
        write_figure(draw_loss_curve(CURVE), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
