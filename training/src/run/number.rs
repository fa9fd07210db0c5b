//! Numbers in JSON, those included that JSON does not know.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A number, or its name.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Number(pub(super) f64);

impl Serialize for Number {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            value if value.is_finite() => serializer.serialize_f64(value),
            value if value.is_nan() => serializer.serialize_str("NaN"),
            value if value > 0.0 => serializer.serialize_str("inf"),
            _ => serializer.serialize_str("-inf"),
        }
    }
}

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "a number, \"NaN\", \"inf\" or \"-inf\" expected")]
        enum Found {
            Value(f64),
            Name(Name),
        }
        #[derive(Deserialize)]
        enum Name {
            NaN,
            #[serde(rename = "inf")]
            Infinite,
            #[serde(rename = "-inf")]
            MinusInfinite,
        }
        Ok(Self(match Found::deserialize(deserializer)? {
            Found::Value(value) => value,
            Found::Name(Name::NaN) => f64::NAN,
            Found::Name(Name::Infinite) => f64::INFINITY,
            Found::Name(Name::MinusInfinite) => f64::NEG_INFINITY,
        }))
    }
}

/// For `serde(with)` on an `Option<f64>`.
pub(super) mod option {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(value: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        value.map(Number).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
        Ok(Option::<Number>::deserialize(deserializer)?.map(|number| number.0))
    }
}

/// For `serde(with)` on a `BTreeMap<String, f64>`.
pub(super) mod map {
    use std::collections::BTreeMap;

    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        values: &BTreeMap<String, f64>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_map(values.iter().map(|(name, value)| (name, Number(*value))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<BTreeMap<String, f64>, D::Error> {
        let values = BTreeMap::<String, Number>::deserialize(deserializer)?;
        Ok(values.into_iter().map(|(name, number)| (name, number.0)).collect())
    }
}
