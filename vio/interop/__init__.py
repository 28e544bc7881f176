"""Poses, covariances, cameras and points to and from other systems.

One module for each system; none imports its package before a function is called. Everywhere `T` is
a transform (4, 4), and a covariance (6, 6) is that of `xi = [rho; phi]`, metres and radians, on the
body's side: `T_world_body = T_hat exp(xi)`. `Estimate.covariance` is of this form: there xi has the
other sign, which no covariance shows. What each system takes instead is said in its module and in
docs/neighbours.md.
"""
