"""What makes a kernel, and what it computes with: compilation, vectors, polynomials."""
