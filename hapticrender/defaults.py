"""What is taken where nobody has chosen."""

METHOD = "h2"  # the best of `control.methods`; where the delay is long its inner loop switches itself off
