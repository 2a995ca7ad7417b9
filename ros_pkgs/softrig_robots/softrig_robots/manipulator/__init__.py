"""A 3-link arm whose motor voltages are controlled without a model of the arm.

M. R. Shokoohinia and M. M. Fateh, Model-free tracking control via adaptive dynamic sliding mode control with
application to robotic systems, International Journal of Industrial Electronics, Control and Optimization (IECO).
"""
