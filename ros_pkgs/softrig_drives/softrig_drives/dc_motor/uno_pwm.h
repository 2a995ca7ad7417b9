/* From a voltage to the PWM register. Include after the header of a controller, which defines real_t; VMAX is the supply. */
#ifndef UNO_PWM_H
#define UNO_PWM_H

/* The voltage as 8 bits and a sign: limited before the cast; what is no number drives nothing. */
static int16_t pwm_of(real_t u)
{
    real_t m = u * (SR_REAL(255) / SR_REAL(VMAX));
    if (!(m > SR_REAL(-255))) {
        m = (m == m) ? SR_REAL(-255) : SR_REAL(0);
    } else if (m > SR_REAL(255)) {
        m = SR_REAL(255);
    }
    return (int16_t)((m < SR_REAL(0)) ? (m - SR_REAL(0.5)) : (m + SR_REAL(0.5)));
}

#endif
