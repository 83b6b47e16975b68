"""Model poses by back-constrained Gaussian process latent variable models."""
