"""One page that turns under the mouse: shape, contacts, postures of the hand, and the closing replayed."""

from torchgrasp.app.report.turning.document import VIEW, write_viewer

__all__ = ["VIEW", "write_viewer"]
