"""A hip and knee rehabilitation robot under voltage control with an impedance law around it.

M. Jalaeian F., M. M. Fateh and M. Rahimiyan, Optimal impedance voltage-controller for electrically driven robots,
International Journal of Industrial Electronics, Control and Optimization (IECO).
"""
