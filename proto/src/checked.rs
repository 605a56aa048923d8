//! Messages of `slabcast.render.v1` with a checksum: the codec of its clients and masters.
//!
//! Each message begins with field 2047, a fixed32: the CRC-32C of all bytes after it. Protobuf lets
//! fields come in any order and has readers skip those that they don't know. So clients in other
//! languages need not know of it, and a message without it is read unchecked.
//!
//! A message whose checksum is false is DATA_LOSS: whoever sent it sends it again. The field comes
//! first, since it can't be told from payload at the end. A message whose first two bytes differ
//! from field 2047 in one bit has the field, damaged; no message of `render.proto` begins so.

use bytes::{Buf, BufMut, Bytes};
use prost::Message;
use std::marker::PhantomData;
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};

/// Tag of field 2047 as a fixed32.
const MARK: [u8; 2] = [0xfd, 0x7f];

/// Bytes that the checksum adds to a message.
pub const CHECKSUM_BYTES: usize = MARK.len() + size_of::<u32>();

/// Writes messages with their checksum, and checks those that have one.
#[derive(Debug)]
pub struct CheckedCodec<T, U>(PhantomData<fn() -> (T, U)>);

impl<T, U> Default for CheckedCodec<T, U> {
    fn default() -> Self {
        CheckedCodec(PhantomData)
    }
}

/// The encoder of a [`CheckedCodec`].
#[derive(Debug)]
pub struct CheckedEncoder<T>(PhantomData<fn() -> T>);

/// The decoder of a [`CheckedCodec`].
#[derive(Debug)]
pub struct CheckedDecoder<U>(PhantomData<fn() -> U>);

impl<T: Message + 'static, U: Message + Default + 'static> Codec for CheckedCodec<T, U> {
    type Encode = T;
    type Decode = U;
    type Encoder = CheckedEncoder<T>;
    type Decoder = CheckedDecoder<U>;

    fn encoder(&mut self) -> Self::Encoder {
        CheckedEncoder(PhantomData)
    }

    fn decoder(&mut self) -> Self::Decoder {
        CheckedDecoder(PhantomData)
    }
}

impl<T: Message> Encoder for CheckedEncoder<T> {
    type Item = T;
    type Error = Status;

    fn encode(&mut self, item: T, buf: &mut EncodeBuf<'_>) -> Result<(), Status> {
        let payload = item.encode_to_vec();
        buf.reserve(CHECKSUM_BYTES + payload.len());
        buf.put_slice(&MARK);
        buf.put_u32_le(crc32c::crc32c(&payload));
        buf.put_slice(&payload);
        Ok(())
    }
}

impl<U: Message + Default> Decoder for CheckedDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buf: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        // No copy: it is one buffer.
        decode(buf.copy_to_bytes(buf.remaining())).map(Some)
    }
}

/// Checks and decodes one message.
///
/// # Errors
/// DATA_LOSS if its checksum is false; INTERNAL, as of tonic's own codec, if it can't be decoded.
fn decode<U: Message + Default>(mut message: Bytes) -> Result<U, Status> {
    if let [a, b, ..] = message[..] {
        let wrong_bits = (a ^ MARK[0]).count_ones() + (b ^ MARK[1]).count_ones();
        if wrong_bits <= 1 {
            let is_whole = wrong_bits == 0 && message.len() >= CHECKSUM_BYTES && {
                message.advance(MARK.len());
                message.get_u32_le() == crc32c::crc32c(&message)
            };
            if !is_whole {
                return Err(Status::data_loss("a message was damaged on its way; send it again"));
            }
        }
    }
    U::decode(message).map_err(|e| Status::internal(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render_v1::{GetJobRequest, WatchFramesRequest};
    use tonic::Code;

    fn encoded(message: &impl Message) -> Vec<u8> {
        let payload = message.encode_to_vec();
        [&MARK[..], &crc32c::crc32c(&payload).to_le_bytes(), &payload].concat()
    }

    #[test]
    fn each_flipped_bit_of_a_message_is_found() {
        let request = WatchFramesRequest { job_id: "job-7".into(), from_frame: 300 };
        let whole = encoded(&request);
        assert_eq!(decode::<WatchFramesRequest>(whole.clone().into()).unwrap(), request);
        for bit in 0..8 * whole.len() {
            let mut damaged = whole.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            let found = decode::<WatchFramesRequest>(damaged.into());
            assert_eq!(found.unwrap_err().code(), Code::DataLoss, "bit {bit}");
        }
        for bytes in 2..whole.len() {
            let cut = Bytes::copy_from_slice(&whole[..bytes]);
            let found = decode::<WatchFramesRequest>(cut);
            assert_eq!(found.unwrap_err().code(), Code::DataLoss, "{bytes} bytes");
        }
    }

    #[test]
    fn clients_of_other_languages_neither_write_nor_know_the_checksum() {
        let request = GetJobRequest { job_id: "job-7".into() };
        assert_eq!(decode::<GetJobRequest>(request.encode_to_vec().into()).unwrap(), request);
        assert_eq!(GetJobRequest::decode(&encoded(&request)[..]).unwrap(), request);
        let empty = GetJobRequest::default();
        assert_eq!(decode::<GetJobRequest>(Bytes::new()).unwrap(), empty);
        assert_eq!(decode::<GetJobRequest>(encoded(&empty).into()).unwrap(), empty);
    }

    #[test]
    fn garbage_without_a_checksum_is_not_called_damaged() {
        let found = decode::<GetJobRequest>(Bytes::from_static(&[0x0a, 0x20, 1]));
        let status = found.unwrap_err();
        assert_eq!(status.code(), Code::Internal);
        assert!(status.message().starts_with("failed to decode Protobuf message"));
    }
}
