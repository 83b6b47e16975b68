"""Back-constrained Gaussian process latent variable models of poses."""
