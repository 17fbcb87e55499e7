"""How well a method does where methods fail, against stated targets."""
