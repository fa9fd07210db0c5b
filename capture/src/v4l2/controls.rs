//! Camera controls (exposure, gain, ...) by name, set and read back.
//!
//! The enumeration of crate `v4l` panics on control types that it does not know, so this asks the driver itself.
#![allow(unsafe_code)]

use std::collections::BTreeMap;
use std::ffi::CStr;
use std::os::raw::c_void;
use std::{io, mem, ptr};

use v4l::control::{Control, Value};
use v4l::v4l_sys::{V4L2_CTRL_FLAG_NEXT_CTRL, v4l2_control, v4l2_query_ext_ctrl};
use v4l::{Device, v4l2};

/// Control types whose value is one number: integer, boolean, menu, 64-bit integer, bit mask, integer menu.
const NUMBERS: [u32; 6] = [1, 2, 3, 5, 8, 9];
/// `V4L2_CTRL_TYPE_INTEGER64`.
const INTEGER64: u32 = 5;
/// What a device that was pulled out answers.
const ENODEV: i32 = 19;
const EIO: i32 = 5;
/// Disabled, or read-only.
const UNSETTABLE: u32 = 0x0001 | 0x0004;

/// A control that takes one number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ControlInfo {
    /// The driver's id.
    pub id: u32,
    /// The driver's name in the form that configuration uses: `exposure_time_absolute`.
    pub name: String,
    /// Smallest value.
    pub minimum: i64,
    /// Largest value.
    pub maximum: i64,
    /// Distance between values.
    pub step: u64,
    /// Value after power-up.
    pub default: i64,
    /// Whether it can be set.
    pub settable: bool,
    wide: bool,
}

/// Every control of the device that takes one number, in the driver's order.
pub(super) fn list(device: &Device) -> Vec<ControlInfo> {
    let mut controls = Vec::new();
    let mut id = 0;
    loop {
        // SAFETY: all-zero is a valid v4l2_query_ext_ctrl.
        let mut query: v4l2_query_ext_ctrl = unsafe { mem::zeroed() };
        query.id = id | V4L2_CTRL_FLAG_NEXT_CTRL;
        // SAFETY: VIDIOC_QUERY_EXT_CTRL reads and writes one v4l2_query_ext_ctrl.
        let answer = unsafe {
            let argument = ptr::from_mut(&mut query).cast::<c_void>();
            v4l2::ioctl(device.handle().fd(), v4l2::vidioc::VIDIOC_QUERY_EXT_CTRL, argument)
        };
        if answer.is_err() || query.id <= id {
            return controls;
        }
        id = query.id;
        if !NUMBERS.contains(&query.type_) {
            continue;
        }
        // SAFETY: the kernel ends the name with a zero byte within its 32 bytes.
        let name = unsafe { CStr::from_ptr(query.name.as_ptr()) }.to_string_lossy();
        controls.push(ControlInfo {
            id,
            name: key(&name),
            minimum: query.minimum,
            maximum: query.maximum,
            step: query.step,
            default: query.default_value,
            settable: query.flags & UNSETTABLE == 0,
            wide: query.type_ == INTEGER64,
        });
    }
}

/// Why the controls are not as asked.
#[derive(Debug)]
pub(super) enum ControlError {
    /// This camera cannot have it: which control, what was asked, what is allowed.
    Refused(String),
    /// The camera has gone meanwhile.
    Device(io::Error),
}

/// Sets each control by name and reads it back.
pub(super) fn apply(device: &Device, wanted: &BTreeMap<String, i64>) -> Result<(), ControlError> {
    let available = if wanted.is_empty() { Vec::new() } else { list(device) };
    let mut checked = Vec::new();
    for (name, &value) in wanted {
        checked.push((name, find(&available, name, value).map_err(ControlError::Refused)?, value));
    }
    // A control may be refused until another one is set (an exposure while the automatic owns it): the first round
    // only sets, the second tells.
    for (_, control, value) in &checked {
        let _ = write(device, control, *value);
    }
    for (name, control, value) in checked {
        let failed = |what: &str, error: io::Error| match error.raw_os_error() {
            Some(ENODEV | EIO) => ControlError::Device(error),
            _ => ControlError::Refused(format!("control '{name}' = {value} {what}: {error}")),
        };
        write(device, control, value).map_err(|e| failed("was refused", e))?;
        let found = read(device, control).map_err(|e| failed("cannot be read back", e))?;
        if found != value {
            let ControlInfo { minimum, maximum, step, .. } = control;
            return Err(ControlError::Refused(format!(
                "control '{name}' was set to {value} and reads {found} (allowed: {minimum}..{maximum} in steps of {step}; \
                 an automatic mode may own it)"
            )));
        }
    }
    Ok(())
}

fn find<'a>(available: &'a [ControlInfo], name: &str, value: i64) -> Result<&'a ControlInfo, String> {
    let Some(control) = available.iter().find(|c| c.name == key(name)) else {
        let names: Vec<_> = available.iter().filter(|c| c.settable).map(|c| c.name.as_str()).collect();
        return Err(format!("it has no control '{name}' (it has: {})", names.join(", ")));
    };
    if !control.settable {
        return Err(format!("its control '{name}' cannot be set"));
    }
    if value < control.minimum || value > control.maximum {
        return Err(format!(
            "control '{name}' = {value} lies outside {}..{}",
            control.minimum, control.maximum
        ));
    }
    Ok(control)
}

fn write(device: &Device, control: &ControlInfo, value: i64) -> io::Result<()> {
    device.set_control(Control { id: control.id, value: Value::Integer(value) })
}

fn read(device: &Device, control: &ControlInfo) -> io::Result<i64> {
    if control.wide {
        return match device.control(control.id)?.value {
            Value::Integer(value) => Ok(value),
            other => Err(io::Error::other(format!("a 64-bit control reads {other:?}"))),
        };
    }
    let mut argument = v4l2_control { id: control.id, value: 0 };
    // SAFETY: VIDIOC_G_CTRL reads and writes one v4l2_control.
    unsafe {
        let argument = ptr::from_mut(&mut argument).cast::<c_void>();
        v4l2::ioctl(device.handle().fd(), v4l2::vidioc::VIDIOC_G_CTRL, argument)?;
    }
    Ok(argument.value.into())
}

/// `Exposure Time, Absolute` -> `exposure_time_absolute`, as v4l2-ctl writes it.
fn key(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_v4l2_ctl() {
        assert_eq!(key("Exposure Time, Absolute"), "exposure_time_absolute");
        assert_eq!(key("White Balance, Automatic"), "white_balance_automatic");
        assert_eq!(key("gain"), "gain");
    }

    #[test]
    fn what_cannot_be_set_is_refused_with_what_can() {
        let gain = ControlInfo {
            id: 1,
            name: "gain".into(),
            minimum: 0,
            maximum: 255,
            step: 1,
            default: 9,
            settable: true,
            wide: false,
        };
        let fixed = ControlInfo { name: "serial".into(), settable: false, ..gain.clone() };
        let available = [gain, fixed];
        assert_eq!(find(&available, "Gain", 255).unwrap().name, "gain");
        assert!(find(&available, "gian", 1).unwrap_err().ends_with("(it has: gain)"));
        assert!(find(&available, "gain", 256).unwrap_err().contains("outside 0..255"));
        assert!(find(&available, "serial", 1).unwrap_err().contains("cannot be set"));
    }
}
