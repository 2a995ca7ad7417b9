! The law of pi.c with its integral in a saved variable.
module law
  use iso_c_binding
  implicit none
  type, bind(c) :: pi_params
    real(c_float) :: kp, ki, limit, period
  end type
  type, bind(c) :: pi_in
    real(c_float) :: reference, speed
  end type
  type, bind(c) :: pi_out
    real(c_float) :: voltage
  end type
  type, bind(c) :: pi
    type(pi_params) :: p
    real(c_float) :: integral
    integer(c_int16_t) :: ticks
    logical(c_bool) :: saturated
  end type
contains
  subroutine pi_init(s, params) bind(c)
    type(pi), intent(out) :: s
    type(pi_params), intent(in) :: params
    s%p = params; s%integral = 0; s%ticks = 0; s%saturated = .false.
  end subroutine
  integer(c_int) function pi_step(s, i, o, t) bind(c)
    type(pi), intent(inout) :: s
    type(pi_in), intent(in) :: i
    type(pi_out), intent(out) :: o
    integer(c_int64_t), value :: t
    real(c_float), save :: integral = 0
    real(c_float) :: e, u
    e = i%reference - i%speed; u = s%p%kp * e + integral
    s%saturated = u > s%p%limit .or. u < -s%p%limit
    if (.not. s%saturated) integral = integral + s%p%ki * s%p%period * e
    o%voltage = min(max(u, -s%p%limit), s%p%limit); s%ticks = s%ticks + 1_c_int16_t; pi_step = 0
  end function
end module
