//! A transfer function as users give it: by a preset's name or in full.

use serde::{Deserialize, Serialize};
use slabcast_common::transfer::TransferFunction;

/// A transfer function by name or in full. As JSON: a string, or the function.
#[derive(Clone, Debug, PartialEq)]
pub enum TransferChoice {
    /// Name of a preset or colour map, which the master fits to its volume.
    Name(String),
    /// A function in full.
    Function(Box<TransferFunction>),
}

impl TransferChoice {
    /// Returns the bytes that the choice takes in memory beside its own size.
    pub fn held_bytes(&self) -> usize {
        match self {
            TransferChoice::Name(name) => name.len(),
            TransferChoice::Function(tf) => crate::request::function_bytes(tf),
        }
    }
}

impl Serialize for TransferChoice {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            TransferChoice::Name(name) => to.serialize_str(name),
            TransferChoice::Function(tf) => tf.serialize(to),
        }
    }
}

impl<'de> Deserialize<'de> for TransferChoice {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        // Not `untagged`: that would lose what is wrong inside of the function.
        match serde_json::Value::deserialize(from)? {
            serde_json::Value::String(name) => Ok(TransferChoice::Name(name)),
            object @ serde_json::Value::Object(_) => serde_json::from_value(object)
                .map(|tf| TransferChoice::Function(Box::new(tf)))
                .map_err(|e| D::Error::custom(format!("tf: {e}"))),
            _ => Err(D::Error::custom("tf: must be a preset's name or a transfer function")),
        }
    }
}
