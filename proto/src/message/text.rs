//! Text of a fixed size inside a message.

use core::fmt;

use iceoryx2::prelude::ZeroCopySend;

/// UTF-8 text in `N` bytes, padded with NUL.
///
/// Writing truncates at a character boundary; reading survives whatever bytes another process left
/// there: the text ends at the first NUL, and bytes that are no UTF-8 read as `U+FFFD`.
///
/// ```
/// use grnet_proto::FixedText;
/// let name = FixedText::<8>::new("Küchentisch");
/// assert_eq!(name.to_string(), "Küchent");
/// assert_eq!(FixedText::<4>::from_bytes([b'o', b'k', 0, 0xFF]).to_string(), "ok");
/// ```
#[derive(Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
#[repr(C)]
pub struct FixedText<const N: usize> {
    bytes: [u8; N],
}

impl<const N: usize> FixedText<N> {
    /// No text.
    pub const EMPTY: Self = Self { bytes: [0; N] };

    /// The text, cut at the last character that fits and at the first NUL.
    pub fn new(text: &str) -> Self {
        let text = text.split('\0').next().unwrap_or_default();
        let mut end = text.len().min(N);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        let mut bytes = [0; N];
        bytes[..end].copy_from_slice(&text.as_bytes()[..end]);
        Self { bytes }
    }

    /// The text whose bytes these are, as another process may have written them.
    pub const fn from_bytes(bytes: [u8; N]) -> Self {
        Self { bytes }
    }

    /// All `N` bytes, padding included.
    pub const fn as_bytes(&self) -> &[u8; N] {
        &self.bytes
    }

    /// Is there no text?
    pub fn is_empty(&self) -> bool {
        self.text_bytes().is_empty()
    }

    fn text_bytes(&self) -> &[u8] {
        let end = self.bytes.iter().position(|&byte| byte == 0).unwrap_or(N);
        &self.bytes[..end]
    }
}

impl<const N: usize> Default for FixedText<N> {
    fn default() -> Self {
        Self::EMPTY
    }
}

impl<const N: usize> From<&str> for FixedText<N> {
    fn from(text: &str) -> Self {
        Self::new(text)
    }
}

impl<const N: usize> fmt::Display for FixedText<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&String::from_utf8_lossy(self.text_bytes()))
    }
}

impl<const N: usize> fmt::Debug for FixedText<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", String::from_utf8_lossy(self.text_bytes()))
    }
}

impl<const N: usize> PartialEq<str> for FixedText<N> {
    fn eq(&self, other: &str) -> bool {
        self.text_bytes() == other.as_bytes()
    }
}

impl<const N: usize> PartialEq<&str> for FixedText<N> {
    fn eq(&self, other: &&str) -> bool {
        *self == **other
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn cuts_at_a_character_boundary() {
        assert_eq!(FixedText::<3>::new("aäö").to_string(), "aä");
        assert_eq!(FixedText::<2>::new("€").to_string(), "");
    }

    #[test]
    fn a_nul_ends_the_text() {
        let text = FixedText::<8>::new("a\0b");
        assert_eq!(text.to_string(), "a");
        assert_eq!(text.as_bytes(), b"a\0\0\0\0\0\0\0");
    }

    proptest! {
        #[test]
        fn what_fits_reads_back(text in "[^\0]{0,16}") {
            prop_assume!(text.len() <= 64);
            prop_assert_eq!(FixedText::<64>::new(&text).to_string(), text);
        }

        #[test]
        fn what_does_not_fit_is_a_prefix(text in "[^\0]{0,40}") {
            let short = FixedText::<16>::new(&text).to_string();
            prop_assert!(text.starts_with(&short));
            prop_assert!(text.len() - short.len() < 4 || short.len() > 12);
        }

        #[test]
        fn foreign_bytes_are_readable(bytes in any::<[u8; 12]>()) {
            let text = FixedText::<12>::from_bytes(bytes);
            prop_assert!(text.to_string().chars().count() <= 12);
            prop_assert!(!text.to_string().contains('\0'));
        }
    }
}
