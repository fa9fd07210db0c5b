//! A small memory-mapped streaming loop over V4L2 buffers.
//!
//! The stream of crate `v4l` answers EINVAL for ever after one timeout, panics in `Drop` on errors other than
//! ENODEV, and hands out whole buffers whatever the driver filled. This one waits with `poll`, cuts at `bytesused`,
//! gives each buffer back as soon as it was read, and closes without panicking. Source: the Linux kernel's
//! userspace API documentation, "Streaming I/O (Memory Mapping)".
#![allow(unsafe_code)]

use std::io;
use std::os::raw::c_void;
use std::sync::Arc;
use std::time::Duration;
use std::{mem, ptr};

use v4l::device::Handle;
use v4l::v4l_sys::{
    V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, v4l2_buffer,
    v4l2_requestbuffers,
};
use v4l::{Device, v4l2};

/// `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
const VIDEO_CAPTURE: u32 = 1;
/// `V4L2_MEMORY_MMAP`.
const MEMORY_MMAP: u32 = 1;
/// `PROT_READ | PROT_WRITE`: drivers that fill the buffer by CPU ask for both.
const READ_WRITE: i32 = 0x1 | 0x2;
/// `MAP_SHARED`.
const MAP_SHARED: i32 = 0x1;
/// `POLLIN`.
const POLLIN: i16 = 0x1;

/// One filled buffer, valid until the reading closure returns.
pub(super) struct Filled<'a> {
    /// The bytes that the driver filled (`bytesused`).
    pub bytes: &'a [u8],
    /// The driver's frame counter; wraps at 2^32.
    pub sequence: u32,
    /// Driver time stamp on `CLOCK_MONOTONIC` in nanoseconds; `None` when the driver stamps on another clock.
    pub monotonic_ns: Option<u64>,
    /// The driver says that the data may be corrupt (`V4L2_BUF_FLAG_ERROR`).
    pub corrupt: bool,
}

struct Mapping {
    start: *mut c_void,
    length_bytes: usize,
}

/// Buffers that are queued at the driver and a stream that is on; both end with the value.
pub(super) struct Stream {
    handle: Arc<Handle>,
    mappings: Vec<Mapping>,
}

// SAFETY: the mappings are owned by this value alone and are touched only through `&mut self`; the kernel does not care
// which thread does so.
unsafe impl Send for Stream {}

impl Stream {
    /// Asks the driver for `count` buffers, maps and queues them and turns the stream on.
    pub fn start(device: &Device, count: u32) -> io::Result<Self> {
        let mut stream = Self { handle: device.handle(), mappings: Vec::new() };
        let granted = stream.request_buffers(count)?;
        for index in 0..granted {
            let mapping = stream.map(index)?;
            stream.mappings.push(mapping);
            stream.queue(index)?;
        }
        let mut kind = VIDEO_CAPTURE;
        // SAFETY: VIDIOC_STREAMON reads one int.
        unsafe { stream.ioctl(v4l2::vidioc::VIDIOC_STREAMON, &mut kind)? };
        Ok(stream)
    }

    /// Waits at most `timeout` for a filled buffer, lets `read` look at it and gives it back to the driver.
    ///
    /// `Ok(None)` means that no frame came in time; the stream goes on.
    pub fn next<R>(
        &mut self,
        timeout: Duration,
        read: impl FnOnce(Filled<'_>) -> R,
    ) -> io::Result<Option<R>> {
        // Rounded up: what is left of a millisecond must not become a poll that does not wait.
        let timeout_ms = i32::try_from(timeout.as_micros().div_ceil(1000)).unwrap_or(i32::MAX);
        match self.handle.poll(POLLIN, timeout_ms) {
            Ok(0) => return Ok(None),
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Ok(None),
            Err(error) => return Err(error),
        }
        let mut buffer = empty_buffer();
        // SAFETY: VIDIOC_DQBUF reads and writes one v4l2_buffer.
        match unsafe { self.ioctl(v4l2::vidioc::VIDIOC_DQBUF, &mut buffer) } {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(error) => return Err(error),
        }
        let mapping = self.mappings.get(buffer.index as usize).ok_or_else(|| {
            io::Error::other(format!("the driver filled buffer {} of {}", buffer.index, self.mappings.len()))
        })?;
        let used_bytes = (buffer.bytesused as usize).min(mapping.length_bytes);
        // SAFETY: the mapping is `length_bytes` long and lives as long as `self`; between DQBUF and QBUF the driver
        // does not write to it, and the slice ends before `queue` below.
        let bytes = unsafe { std::slice::from_raw_parts(mapping.start.cast::<u8>(), used_bytes) };
        let monotonic = buffer.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK == V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
        let result = read(Filled {
            bytes,
            sequence: buffer.sequence,
            monotonic_ns: monotonic.then(|| nanoseconds(buffer.timestamp.tv_sec, buffer.timestamp.tv_usec)),
            corrupt: buffer.flags & V4L2_BUF_FLAG_ERROR != 0,
        });
        self.queue(buffer.index)?;
        Ok(Some(result))
    }

    fn request_buffers(&self, count: u32) -> io::Result<u32> {
        // SAFETY: all-zero is a valid v4l2_requestbuffers.
        let mut request: v4l2_requestbuffers = unsafe { mem::zeroed() };
        request.count = count;
        request.type_ = VIDEO_CAPTURE;
        request.memory = MEMORY_MMAP;
        // SAFETY: VIDIOC_REQBUFS reads and writes one v4l2_requestbuffers.
        unsafe { self.ioctl(v4l2::vidioc::VIDIOC_REQBUFS, &mut request)? };
        if request.count == 0 {
            Err(io::Error::other("the driver granted no buffer"))
        } else {
            Ok(request.count)
        }
    }

    fn map(&self, index: u32) -> io::Result<Mapping> {
        let mut buffer = v4l2_buffer { index, ..empty_buffer() };
        // SAFETY: VIDIOC_QUERYBUF reads and writes one v4l2_buffer.
        unsafe { self.ioctl(v4l2::vidioc::VIDIOC_QUERYBUF, &mut buffer)? };
        let length_bytes = buffer.length as usize;
        // SAFETY: for V4L2_MEMORY_MMAP the driver filled `m.offset`.
        let offset = unsafe { buffer.m.offset };
        // SAFETY: a fresh shared mapping at an address of the kernel's choice, of the length that the driver stated.
        let start = unsafe {
            v4l2::mmap(
                ptr::null_mut(),
                length_bytes,
                READ_WRITE,
                MAP_SHARED,
                self.handle.fd(),
                offset.into(),
            )?
        };
        Ok(Mapping { start, length_bytes })
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        let mut buffer = v4l2_buffer { index, ..empty_buffer() };
        // SAFETY: VIDIOC_QBUF reads and writes one v4l2_buffer.
        unsafe { self.ioctl(v4l2::vidioc::VIDIOC_QBUF, &mut buffer) }
    }

    /// # Safety
    /// `argument` must be of the type that `request` reads and writes.
    unsafe fn ioctl<T>(&self, request: v4l2::vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        // SAFETY: the caller promises the type; the reference is valid for the call.
        unsafe { v4l2::ioctl(self.handle.fd(), request, ptr::from_mut(argument).cast::<c_void>()) }
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        let mut kind = VIDEO_CAPTURE;
        // A device that was pulled out refuses every one of these calls, and there is nothing left to end.
        // SAFETY: VIDIOC_STREAMOFF reads one int.
        let _ = unsafe { self.ioctl(v4l2::vidioc::VIDIOC_STREAMOFF, &mut kind) };
        for mapping in self.mappings.drain(..) {
            // SAFETY: mapped by `map` with this length and not used after this point.
            let _ = unsafe { v4l2::munmap(mapping.start, mapping.length_bytes) };
        }
    }
}

fn empty_buffer() -> v4l2_buffer {
    // SAFETY: all-zero is a valid v4l2_buffer.
    let mut buffer: v4l2_buffer = unsafe { mem::zeroed() };
    buffer.type_ = VIDEO_CAPTURE;
    buffer.memory = MEMORY_MMAP;
    buffer
}

/// Microseconds are what `v4l2_buffer` has.
fn nanoseconds(seconds: i64, microseconds: i64) -> u64 {
    let (seconds, microseconds) =
        (u64::try_from(seconds).unwrap_or(0), u64::try_from(microseconds).unwrap_or(0));
    seconds.saturating_mul(1_000_000_000).saturating_add(microseconds.saturating_mul(1_000))
}

#[cfg(test)]
mod tests {
    use super::nanoseconds;

    #[test]
    fn absurd_stamps_do_not_overflow() {
        assert_eq!(nanoseconds(2, 7), 2_000_007_000);
        assert_eq!(nanoseconds(-1, -1), 0);
        assert_eq!(nanoseconds(i64::MAX, 0), u64::MAX);
    }
}
