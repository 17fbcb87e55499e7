"""One renderer a device kind: turns a scene into bands, a band model and a plant."""
