//! Identities: of one run of the daemon, and of files by their content.

use core::fmt;

use iceoryx2::prelude::ZeroCopySend;

use super::layout::WireType;

/// Names one run of the daemon: a client that sees another boot id knows that counters, odometry and
/// state started anew.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default, ZeroCopySend)]
#[repr(C)]
pub struct BootId(pub [u8; 16]);

impl BootId {
    /// No run: never given by a running daemon.
    pub const NONE: Self = Self([0; 16]);

    /// 128 random bits from the kernel.
    ///
    /// # Errors
    /// When the kernel gives no random bits, which a supported kernel does not do.
    pub fn random() -> std::io::Result<Self> {
        let mut bytes = [0; 16];
        let mut filled = 0;
        while filled < bytes.len() {
            filled += rustix::rand::getrandom(&mut bytes[filled..], rustix::rand::GetRandomFlags::empty())?;
        }
        Ok(Self(bytes))
    }
}

/// The SHA-256 of a file's content; all zero when there is no file.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default, ZeroCopySend)]
#[repr(C)]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// No content.
    pub const NONE: Self = Self([0; 32]);

    /// The first 12 hexadecimal digits: enough to tell files apart by eye.
    pub fn short(&self) -> String {
        hex(&self.0[..6])
    }
}

fn hex(bytes: &[u8]) -> String {
    use fmt::Write as _;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

macro_rules! identity {
    ($($name:ident),*) => {$(
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&hex(&self.0))
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Display::fmt(self, f)
            }
        }

        impl WireType for $name {
            fn write_bytes(&self, out: &mut Vec<u8>) {
                out.extend_from_slice(&self.0);
            }

            fn ctype() -> String {
                format!("ctypes.c_uint8 * {}", size_of::<Self>())
            }
        }
    )*};
}

identity!(BootId, ContentHash);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_boots_differ() {
        let (a, b) = (BootId::random().unwrap(), BootId::random().unwrap());
        assert_ne!(a, b);
        assert_ne!(a, BootId::NONE);
        assert_eq!(a.to_string().len(), 32);
    }

    #[test]
    fn prints_as_hexadecimal() {
        let mut hash = ContentHash::NONE;
        hash.0[0] = 0xAB;
        assert_eq!(hash.short(), "ab0000000000");
        assert_eq!(hash.to_string().len(), 64);
    }
}
