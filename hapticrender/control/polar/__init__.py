"""The paper's controller: magnitude and phase of every band."""
