//! Volumes of a master: list, describe, put and remove.

use crate::{Client, ClientError, PATIENCE};
use bytes::Bytes;
use slabcast_common::volume::{Digest32, Samples};
use slabcast_proto::convert;
use slabcast_proto::model::{UploadPart, VolumeDescription, VolumeHeader, VolumeList};
use slabcast_proto::render_v1 as wire;
use slabcast_proto::status::Reason;
use slabcast_scene::request::VolumeChoice;
use std::time::Duration;
use tokio::time::Instant;

/// Samples of a chunk: with four bytes each it has 1 MiB. Larger ones gain nothing on a LAN, and
/// more is sent again when one is damaged.
const CHUNK_SAMPLES: usize = 1 << 18;

/// First wait before a master that is away is called again; it doubles up to [`LONGEST_WAIT`].
const FIRST_WAIT: Duration = Duration::from_millis(100);
const LONGEST_WAIT: Duration = Duration::from_secs(2);

/// Most times that an upload is begun anew because the master forgot it, or found another digest.
const MOST_BEGUN: u32 = 4;

impl Client {
    /// Returns a volume; the master reads its file if it did not do that yet.
    ///
    /// # Errors
    /// [`ClientError::Volume`] if the master has no such volume or can't read it;
    /// [`ClientError::InvalidField`] if it has several and `choice` names none;
    /// [`ClientError::Lost`] if it is out of reach.
    pub async fn volume(&self, choice: &VolumeChoice) -> Result<VolumeDescription, ClientError> {
        let request =
            wire::DescribeVolumeRequest { volume: convert::volume_choice_to_wire(choice) };
        let volume =
            self.call(async |mut r, request| r.describe_volume(request).await, request).await?;
        convert::volume_from_wire(volume).map_err(|e| self.protocol_error(&e))
    }

    /// Returns the master's volumes, by name, with its versions and clock.
    ///
    /// # Errors
    /// [`ClientError::Lost`] if the master is out of reach, [`ClientError::Protocol`] if it does
    /// not talk like one.
    pub async fn volumes(&self) -> Result<VolumeList, ClientError> {
        let mut all = VolumeList::default();
        let mut page_token = String::new();
        loop {
            let request =
                wire::ListVolumesRequest { page_size: crate::MAX_PAGE as u32, page_token };
            let response =
                self.call(async |mut r, request| r.list_volumes(request).await, request).await?;
            let (page, next) =
                convert::volume_list_from_wire(response).map_err(|e| self.protocol_error(&e))?;
            if page.volumes.is_empty() && !next.is_empty() {
                return Err(self.protocol_error("a page of volumes is empty and not the last"));
            }
            let before = std::mem::take(&mut all.volumes);
            all = VolumeList { volumes: [before, page.volumes].concat(), ..page };
            if next.is_empty() {
                return Ok(all);
            }
            page_token = next;
        }
    }

    /// Uploads a volume to the master, unless the master has it. `samples` are the volume's codes
    /// ([`Volume::codes`]). `told` is called with the bytes of samples that the master has, as they
    /// grow. A broken connection is made again and the upload goes on, unless the master is away
    /// for two minutes.
    ///
    /// [`Volume::codes`]: slabcast_common::volume::Volume::codes
    ///
    /// # Errors
    /// [`ClientError::Volume`] if the master refuses it, with its figures;
    /// [`ClientError::UploadStopped`] if it stays away.
    ///
    /// # Panics
    /// If `samples` are not as many as `header` says.
    pub async fn put_volume(
        &self,
        header: &VolumeHeader,
        samples: &Samples,
        mut told: impl FnMut(u64),
    ) -> Result<(), ClientError> {
        assert_eq!(header.info.lattice.len(), samples.len(), "one sample for each lattice point");
        let digest = header.info.digest;
        let mut outage: Option<(Instant, Duration)> = None;
        let (mut begun, mut at) = (0, None);
        loop {
            let part = match at {
                None => UploadPart::Begin(Box::new(header.clone())),
                Some(offset) => chunk(digest, samples, offset),
            };
            let request = convert::upload_to_wire(&part);
            let answer =
                self.call(async |mut r, request| r.put_volume(request).await, request).await;
            match answer {
                Ok(answer) => {
                    outage = None;
                    told(answer.received_bytes);
                    if answer.done {
                        return Ok(());
                    }
                    at = Some(answer.received_bytes);
                }
                Err(e) if e.is_passing() => {
                    let (since, wait) = *outage.get_or_insert((Instant::now(), FIRST_WAIT));
                    let after = since.elapsed();
                    if after + wait > PATIENCE {
                        let (address, last) = (self.address().to_owned(), e.to_string());
                        return Err(ClientError::UploadStopped { address, after, last });
                    }
                    tokio::time::sleep(wait).await;
                    outage = Some((since, (2 * wait).min(LONGEST_WAIT)));
                    at = None;
                }
                // The master was restarted, or dropped an upload that stood still.
                Err(ClientError::Volume { reason: Reason::VolumeNotFound, .. })
                    if begun < MOST_BEGUN =>
                {
                    begun += 1;
                    at = None;
                }
                Err(e) => return Err(e),
            }
        }
    }

    /// Removes a volume that a client put on the master.
    ///
    /// # Errors
    /// [`ClientError::Volume`] if there is none of that name, or jobs draw it.
    pub async fn remove_volume(&self, name: &str) -> Result<(), ClientError> {
        let request = wire::RemoveVolumeRequest { name: name.to_owned() };
        self.call(async |mut r, request| r.remove_volume(request).await, request).await.map(drop)
    }
}

/// Returns the chunk that begins at byte `offset` or before it.
fn chunk(digest: Digest32, samples: &Samples, offset: u64) -> UploadPart {
    let bytes = samples.kind().bytes() as u64;
    let begin = ((offset / bytes) as usize).min(samples.len());
    let end = (begin + CHUNK_SAMPLES).min(samples.len());
    let data = Bytes::from(samples.le_bytes(begin..end).into_owned());
    UploadPart::Chunk { digest, offset: begin as u64 * bytes, data }
}
