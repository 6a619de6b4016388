// Reads an episode as Foxglove does and prints what it found as one JSON object.
//
//   node foxglove_reader.mjs PACKAGES FILE
//
// PACKAGES holds node_modules. Any problem is an exception.

import { open } from 'node:fs/promises';
import { createRequire } from 'node:module';
import { join } from 'node:path';

const [packages, file] = process.argv.slice(2);
const require = createRequire(join(packages, 'package.json'));
const { McapIndexedReader } = require('@mcap/core');
const { loadDecompressHandlers } = require('@mcap/support');
const { FileHandleReadable } = require('@mcap/nodejs');
const { parse } = require('@foxglove/rosmsg');
const { MessageReader } = require('@foxglove/rosmsg2-serialization');

const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(await open(file, 'r')),
  decompressHandlers: await loadDecompressHandlers(),
});

const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
  decoders.set(channel.id, new MessageReader(definition));
}

const counts = {};
const positions = [];
let trailing = 0;
let last = -1n;
for await (const message of reader.readMessages()) {
  if (message.logTime <= last) throw new Error(`log time ${message.logTime} does not grow`);
  last = message.logTime;
  const { topic } = reader.channelsById.get(message.channelId);
  const decoder = decoders.get(message.channelId);
  const decoded = decoder.readMessage(message.data);
  if (decoder.lastReadHadTrailingBytes()) trailing += 1;
  counts[topic] = (counts[topic] ?? 0) + 1;
  if (topic === '/joint_states') positions.push(Array.from(decoded.position));
}
const metadata = {};
for await (const record of reader.readMetadata()) {
  metadata[record.name] = Object.fromEntries(record.metadata);
}
let attachments = 0;
for await (const attachment of reader.readAttachments()) attachments += attachment.data.length > 0;
console.log(JSON.stringify({ counts, positions, trailing, metadata, attachments }));
