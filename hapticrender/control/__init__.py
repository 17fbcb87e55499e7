"""How every band is made to follow its target."""
