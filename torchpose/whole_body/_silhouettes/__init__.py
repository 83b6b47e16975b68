"""Render silhouettes of articulated bodies, count them against observed ones, and weigh them."""
