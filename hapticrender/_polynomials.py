"""Temporary."""

from hapticrender._jit import kernel
from hapticrender._lanes import nearest


@kernel
def unit(turns):
    x = turns - nearest(turns)
    half = 0.5 * x
    u = half * half * 39.47841760435743
    s = 1.0 / 6227020800.0 / 210 / 272 / 342
    # sin(pi x) and cos(pi x), then double the angle
    y = half * 6.283185307179586
    c = 1.0 - u * (
        1.0 / 2
        - u
        * (
            1.0 / 24
            - u
            * (
                1.0 / 720
                - u
                * (
                    1.0 / 40320
                    - u
                    * (
                        1.0 / 3628800
                        - u
                        * (
                            1.0 / 479001600
                            - u * (1.0 / 87178291200 - u * (1.0 / 20922789888000.0 - u * (1.0 / 6402373705728000.0)))
                        )
                    )
                )
            )
        )
    )
    n = y * (
        1.0
        - u
        * (
            1.0 / 6
            - u
            * (
                1.0 / 120
                - u
                * (
                    1.0 / 5040
                    - u
                    * (
                        1.0 / 362880
                        - u
                        * (
                            1.0 / 39916800
                            - u
                            * (
                                1.0 / 6227020800.0
                                - u
                                * (
                                    1.0 / 1307674368000.0
                                    - u * (1.0 / 355687428096000.0 - u * (1.0 / 121645100408832000.0))
                                )
                            )
                        )
                    )
                )
            )
        )
    )
    return c * c - n * n, 2.0 * c * n
