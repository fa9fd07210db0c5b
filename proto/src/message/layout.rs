//! How messages lie in memory: one declaration per message gives the struct, the compile-time checks
//! of every offset, its bytes and its Python twin.

/// One field of a message, for tools that generate bindings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Name in Rust, C and Python.
    pub name: &'static str,
    /// Bytes from the start of the message.
    pub offset: usize,
    /// Size in bytes.
    pub size: usize,
    /// The type as a Python `ctypes` expression.
    pub ctype: String,
}

/// A message or part of one: its layout as data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// Name of the struct.
    pub name: &'static str,
    /// The type name that iceoryx2 compares, version included.
    pub type_name: &'static str,
    /// Size in bytes.
    pub size: usize,
    /// All fields, in order, without gaps.
    pub fields: Vec<Field>,
}

/// Plain data without padding that can stand in a message.
pub trait WireType: Sized {
    /// Appends the bytes of this value as they lie in memory on a little-endian machine.
    fn write_bytes(&self, out: &mut Vec<u8>);

    /// The type as a Python `ctypes` expression.
    fn ctype() -> String;
}

macro_rules! primitive {
    ($($ty:ty => $ctype:literal),* $(,)?) => {$(
        impl WireType for $ty {
            fn write_bytes(&self, out: &mut Vec<u8>) {
                out.extend_from_slice(&self.to_le_bytes());
            }

            fn ctype() -> String {
                concat!("ctypes.", $ctype).to_owned()
            }
        }
    )*};
}

primitive! { u8 => "c_uint8", u32 => "c_uint32", u64 => "c_uint64", i64 => "c_int64", f32 => "c_float", f64 => "c_double" }

impl<T: WireType, const N: usize> WireType for [T; N] {
    fn write_bytes(&self, out: &mut Vec<u8>) {
        self.iter().for_each(|element| element.write_bytes(out));
    }

    fn ctype() -> String {
        format!("{} * {N}", T::ctype())
    }
}

impl<const N: usize> WireType for super::FixedText<N> {
    fn write_bytes(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(self.as_bytes());
    }

    fn ctype() -> String {
        // Not c_char: Python would hand out everything up to the first NUL and lose foreign bytes silently.
        format!("ctypes.c_uint8 * {N}")
    }
}

/// Declares a message: the struct, and compile-time proof of its size, alignment, offsets and of the
/// absence of padding.
macro_rules! wire_struct {
    (
        $(#[$($meta:tt)*])*
        $name:ident, type_name = $type_name:literal, size = $size:literal, align = $align:literal {
            $( $(#[$($field_meta:tt)*])* $offset:literal => $field:ident : $ty:ty, )*
        }
    ) => {
        $(#[$($meta)*])*
        #[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
        #[type_name($type_name)]
        #[repr(C)]
        pub struct $name {
            $( $(#[$($field_meta)*])* pub $field: $ty, )*
        }

        const _: () = {
            assert!(size_of::<$name>() == $size);
            assert!(align_of::<$name>() == $align);
            $( assert!(core::mem::offset_of!($name, $field) == $offset, stringify!($field)); )*
            assert!(0 $( + size_of::<$ty>() )* == $size, "padding must be a reserved field");
        };

        impl $name {
            /// The name that iceoryx2 compares when a port connects; it carries the version.
            pub const TYPE_NAME: &'static str = $type_name;

            /// The bytes of this message as they lie in shared memory.
            pub fn to_bytes(&self) -> Vec<u8> {
                let mut out = Vec::with_capacity($size);
                $crate::message::layout::WireType::write_bytes(self, &mut out);
                out
            }

            /// The fields with their offsets, for tools that generate bindings.
            pub fn layout() -> $crate::message::layout::Layout {
                $crate::message::layout::Layout {
                    name: stringify!($name),
                    type_name: $type_name,
                    size: $size,
                    fields: vec![ $( $crate::message::layout::Field {
                        name: stringify!($field),
                        offset: $offset,
                        size: size_of::<$ty>(),
                        ctype: <$ty as $crate::message::layout::WireType>::ctype(),
                    }, )* ],
                }
            }
        }

        impl $crate::message::layout::WireType for $name {
            fn write_bytes(&self, out: &mut Vec<u8>) {
                $( $crate::message::layout::WireType::write_bytes(&self.$field, out); )*
            }

            fn ctype() -> String {
                stringify!($name).to_owned()
            }
        }
    };
}

/// Declares a named number: `u32` in memory, so that a value from a newer or broken process is
/// readable and never undefined behaviour.
macro_rules! wire_enum {
    (
        $(#[$($meta:tt)*])*
        $name:ident { $( $(#[$($value_meta:tt)*])* $constant:ident = $value:literal => $text:literal, )* }
    ) => {
        $(#[$($meta)*])*
        #[derive(Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
        #[repr(C)]
        pub struct $name(pub u32);

        const _: () = assert!(size_of::<$name>() == 4 && align_of::<$name>() == 4);

        impl $name {
            $( $(#[$($value_meta)*])* pub const $constant: Self = Self($value); )*

            /// Every value this build knows, with the name that programs print.
            pub const ALL: &'static [(Self, &'static str)] = &[ $( (Self::$constant, $text), )* ];

            /// The name of the value, `None` when this build does not know it.
            pub fn name(self) -> Option<&'static str> {
                Self::ALL.iter().find(|(value, _)| *value == self).map(|(_, name)| *name)
            }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                match self.name() {
                    Some(name) => f.pad(name),
                    None => f.pad(&format!("UNKNOWN({})", self.0)),
                }
            }
        }

        impl core::fmt::Debug for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                core::fmt::Display::fmt(self, f)
            }
        }

        impl $crate::message::layout::WireType for $name {
            fn write_bytes(&self, out: &mut Vec<u8>) {
                self.0.write_bytes(out);
            }

            fn ctype() -> String {
                u32::ctype()
            }
        }
    };
}

pub(crate) use {wire_enum, wire_struct};
