// The law of pi.c with its integral in a static variable.
#![crate_type = "cdylib"]
#[repr(C)] #[derive(Clone, Copy)] pub struct Params { kp: f32, ki: f32, limit: f32, period: f32 }
#[repr(C)] pub struct In { reference: f32, speed: f32 }
#[repr(C)] pub struct Out { voltage: f32 }
#[repr(C)] pub struct Pi { p: Params, integral: f32, ticks: u16, saturated: bool }
static mut INTEGRAL: f32 = 0.0;
#[no_mangle] pub unsafe extern "C" fn pi_init(s: *mut Pi, p: *const Params) { *s = Pi { p: *p, integral: 0.0, ticks: 0, saturated: false }; }
#[no_mangle] pub unsafe extern "C" fn pi_step(s: *mut Pi, i: *const In, o: *mut Out, _t: i64) -> i32 {
    let s = &mut *s; let e = (*i).reference - (*i).speed; let u = s.p.kp * e + INTEGRAL;
    s.saturated = u > s.p.limit || u < -s.p.limit;
    if !s.saturated { INTEGRAL += s.p.ki * s.p.period * e; }
    (*o).voltage = u.clamp(-s.p.limit, s.p.limit); s.ticks = s.ticks.wrapping_add(1); 0 }
