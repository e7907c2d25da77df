"""The algorithms: one module each; :mod:`sb3_fedguide.registry` knows them by name."""
